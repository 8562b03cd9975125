// What this relies on in viser's page is listed in app/ui/viser_adapter.py.
// A click (or Enter) on an element with data-hs: write its word into its bridge's hidden field, whose changes viser sends.
// The number behind the word makes every click a change. Of what changes within 50 ms viser sends only the last, of
// all controls together. So a word waits until nothing has changed for as long, not even by the word before; of two
// words that ask for the same thing the later one counts, but every press that asks for a step does. On a busy page
// timers run late: one that is due later than viser's runs later, but one without any delay may run before it.
const QUIET_MS = 60;
let said = 0, presses = 0, sending = 0, changed = -QUIET_MS;
const set = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set, waiting = new Map();
const whenQuiet = (act, since) => setTimeout(act, Math.max(since + QUIET_MS - performance.now(), 1));
const sendWhenQuiet = () => {
  clearTimeout(sending);
  if (waiting.size) sending = whenQuiet(send, changed);
};
for (const kind of ['input', 'click', 'keydown', 'pointermove']) {
  document.addEventListener(kind, (event) => {
    if (event.target.closest?.('canvas,[data-hs-to]') || (kind === 'pointermove' && !event.buttons)) return;
    if (kind === 'keydown' && !event.target.closest?.('[role=slider]')) return;
    changed = performance.now();
    sendWhenQuiet();
  }, true);
}
const send = () => {
  const [[key, [name, word]]] = waiting, bridge = document.querySelector(`.hs-bridge[data-name="${name}"]`);
  waiting.delete(key);
  const input = bridge?.parentElement.previousElementSibling.querySelector('input'); // or it was taken off the page
  if (input) {
    set.call(input, word + ' #' + (++said) + Math.random().toString(36).slice(2, 6));
    input.dispatchEvent(new Event('input', {bubbles: true}));
  }
  sendWhenQuiet();
};
window.hemislamTell = (name, word, held = false) => {
  const [kind] = word.split(' '), press = kind === 'step' && !held ? ++presses : '';
  waiting.set(`${name} ${kind} ${press}`, [name, word]);
  sendWhenQuiet();
};
window.hemislamSay = (event) => {
  const element = event.target.closest?.('[data-hs]');
  if (!element || (event.type === 'keydown' && (event.key !== 'Enter' || element.tagName === 'BUTTON'))) return;
  const word = element.dataset.hs;
  if (event.detail > 1 && /^(delete|drop) /.test(word)) return; // of a double click, the second one meets the next line
  hemislamTell(element.closest('[data-hs-to]').dataset.hsTo, word);
};

// For the same reason a click on one of viser's buttons waits until what was typed before it has been sent.
let typed = 0;
document.addEventListener('input', () => { typed = performance.now(); }, true);
document.addEventListener('click', (event) => {
  const button = event.target.closest('.mantine-Button-root');
  if (!button || !typed) return;
  event.stopImmediatePropagation();
  whenQuiet(() => { typed = 0; button.click(); }, typed);
}, true);

// On a phone the panel is low, its tabs alone, until one is tapped; the same one lowers it again.
const sheet = document.documentElement.dataset;
sheet.hsSheet = 'low';
document.addEventListener('click', (event) => {
  const tab = event.target.closest('.mantine-Tabs-list [role=tab]');
  if (tab) sheet.hsSheet = tab.ariaSelected === 'true' && sheet.hsSheet === 'high' ? 'low' : 'high';
}, true);

// The panel is closed by hiding it: viser would take all it holds off the page, and what the bar shows with it.
const reopen = document.querySelector('.hs-reopen'), chevron = '[data-dock-region-collapse]';
const close = (event, closed) => { event?.stopImmediatePropagation(); sheet.hsPanel = closed ? 'closed' : 'open'; };
reopen.onclick = () => close(null, false);
for (const kind of ['pointerdown', 'mousedown', 'click', 'keydown']) {
  document.addEventListener(kind, (event) => {
    if (!event.target.closest(chevron) || (kind === 'keydown' && event.key !== 'Enter')) return;
    close(event, kind === 'click' || kind === 'keydown');
    if (sheet.hsPanel === 'closed') reopen.focus();
  }, true);
}

// Escape leaves a dialog, as its last button does.
document.addEventListener('keydown', (event) => {
  if (event.key !== 'Escape' || isBox(event.target) || document.querySelector('.mantine-Combobox-dropdown:not([style*="display: none"])')) return;
  const modals = document.querySelectorAll('.mantine-Modal-body'), last = modals[modals.length - 1];
  if (last) [...last.querySelectorAll('button')].findLast((one) => /^(Cancel|Close)$/.test(one.textContent.trim()))?.click();
  else hemislamTell('opened', '');
});

// The server is told which tab is opened, and of Escape.
new MutationObserver((changes) => {
  for (const {target: tab} of changes) if (tab.role === 'tab' && tab.ariaSelected === 'true') hemislamTell('opened', tab.textContent.trim());
}).observe(document.body, {subtree: true, attributeFilter: ['aria-selected']});

// viser shows a hint for every control but a button. The button's message is in React's data at its element.
const hintOf = (button) => {
  const kept = (kind) => button[Object.keys(button).find((key) => key.startsWith(kind))];
  let part = kept('__reactFiber');
  if (part?.memoizedProps !== kept('__reactProps')) part = part?.alternate; // React keeps two, and one may be outdated
  while (part && !/^Gui(Upload)?ButtonMessage$/.test(part.memoizedProps?.type)) part = part.return;
  return part?.memoizedProps.props.hint || '';
};

// viser's own buttons beside the title have icons only.
const named = {'list-search': 'All commands (Ctrl K)', 'adjustments': 'Connection and scene, as viser has them'};
setInterval(() => {
  for (const [icon, name] of Object.entries(named)) {
    for (const button of document.querySelectorAll(`button:not([title]):has(.tabler-icon-${icon})`)) {
      button.title = name; button.setAttribute('aria-label', name);
    }
  }
  for (const button of document.querySelectorAll('.mantine-Button-root')) button.title = hintOf(button);
  // viser's folders open by the mouse only; here Tab reaches their heads, and Enter opens and closes them.
  for (const head of document.querySelectorAll('.mantine-Paper-root[data-with-border]>.mantine-Paper-root')) {
    if (head.style.cursor !== 'pointer') continue;
    head.classList.add('hs-folder'); head.tabIndex = 0; head.role = 'button';
    head.ariaExpanded = !head.querySelector('.tabler-icon-chevron-down');
  }
}, 1000);

// Show a tab, docked or on a phone, and unfold what is folded in a part of it.
window.hemislamOpenTab = (name, unfolded = '') => {
  const tab = [...document.querySelectorAll('[role=tab]')].find((one) => one.textContent.trim() === name);
  if (!tab) return;
  tab.click();
  tab.dispatchEvent(new KeyboardEvent('keydown', {key: 'Enter', bubbles: true}));
  tab.scrollIntoView({block: 'nearest'});
  if (unfolded) setTimeout(() => { for (const one of document.querySelectorAll(unfolded + ' details')) one.open = true; }, 300);
  sheet.hsSheet = 'high';
  sheet.hsPanel = 'open';
  return tab;
};

// Keys. On its way up an event passes widgets (the page's root), the body, viser's hotkeys (the html element) and
// viser's camera (the document). Left and right move a focused slider or tab, else step a frame, never the camera.
// Another key that is held counts once. Behind a dialog no key counts; in its text fields Enter is its coloured button.
const sideways = (event) => event.key === 'ArrowLeft' || event.key === 'ArrowRight';
document.body.addEventListener('keydown', (event) => {
  if (event.key === 'Escape' || event.key === 'Tab') return;
  if (event.key === 'Enter' && !event.repeat && !event.isComposing && event.target.matches('.mantine-Modal-body .mantine-TextInput-input')) {
    event.target.closest('.mantine-Modal-body').querySelector('.mantine-Button-root:not([style*="gray-filled"])')?.click();
  }
  if (event.key === 'Enter' && event.target.matches('.hs-folder')) event.target.click();
  const taken = sideways(event) ? event.target.closest('[role=slider],[role=tab]') : event.repeat;
  if (taken || document.querySelector('.mantine-Modal-body')) event.stopPropagation();
});
document.documentElement.addEventListener('keydown', (event) => {
  if (!sideways(event)) return;
  event.stopPropagation();
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest('input,textarea,select')) return;
  const target = document.querySelector(`.hs-dock [data-hs="step ${event.key === 'ArrowRight' ? 1 : -1}"]:enabled`);
  if (target) hemislamTell('transport', target.dataset.hs, event.repeat); // a held key steps as fast as the page can
});
// Space plays and pauses. Firefox would also click the focused button again when the key comes up.
document.documentElement.addEventListener('keyup', (event) => {
  if (event.key === ' ' && event.target.closest('button')) event.preventDefault();
});

// A slider that is let go ends one step of undo, once its last value has been sent.
document.addEventListener('pointerdown', (event) => {
  if (!event.target.closest('.mantine-Slider-root')) return;
  window.addEventListener('pointerup', () => setTimeout(hemislamTell, 500, 'sliders', 'released'), {once: true, capture: true});
}, true);

// A tooltip stands beside its panel, over the scene: above its control it would hide the one before.
const beside = (tip) => {
  const scene = document.querySelector('canvas[data-engine]').getBoundingClientRect(), box = tip.getBoundingClientRect();
  if (scene.width < box.width + 16 || (box.left >= scene.left && box.right <= scene.right)) return;
  const aside = box.left > scene.left ? scene.right - 8 - box.right : scene.left + 8 - box.left;
  const dock = document.querySelector('.hs-dock:not([hidden])'), room = (dock ? dock.getBoundingClientRect().top : innerHeight) - 8;
  tip.style.translate = `${aside}px ${Math.min(box.height / 2 + 18, room - box.bottom)}px`;
};
new MutationObserver(() => {
  for (const tip of document.getElementsByClassName('mantine-Tooltip-tooltip')) {
    if (!tip.dataset.hsSeen) { tip.dataset.hsSeen = 1; requestAnimationFrame(() => beside(tip)); }
  }
}).observe(document.body, {childList: true, subtree: true});

// A lost server is said in words. viser itself connects again, every second while the page has the focus.
let missed = 0;
setInterval(() => {
  const lost = document.querySelector('[style*="opacity 150ms"][style*="pointer-events: none"]');
  missed = lost && !document.querySelector('.hs-dock').hidden ? missed + 1 : 0;
  document.querySelector('.hs-lost').hidden = missed < 2; // not for a moment's break
}, 500);

// A number box is taken as a whole, on Enter or when it is left; Escape brings the old number back.
let taking = false;
const isBox = (node) => node.classList && node.classList.contains('mantine-NumberInput-input');
const restore = (box) => { set.call(box, box.defaultValue); box.setCustomValidity(''); };
const take = (box, complain) => {
  const text = box.value.trim().replace('−', '-').replace(',', '.'), value = Number(text);
  const thumb = box.closest('.mantine-Flex-root').querySelector('[role=slider]');
  const [low, high] = thumb ? ['min', 'max'].map((end) => Number(thumb.getAttribute('aria-value' + end))) : [];
  const bad = !text || !isFinite(value) ? 'Enter a number.' : value < low || value > high ? `${low} to ${high}` : '';
  if (bad && complain) { box.setCustomValidity(bad); box.reportValidity(); return; }
  restore(box);
  if (bad) return;
  box.select(); // the widget takes what follows for a paste over all of the old number
  box.dispatchEvent(new KeyboardEvent('keydown', {key: 'Unidentified', bubbles: true}));
  set.call(box, value.toFixed(12).replace(/\.?0+$/, ''));
  taking = true; box.dispatchEvent(new Event('input', {bubbles: true})); taking = false;
};
document.addEventListener('input', (event) => {
  if (!taking && isBox(event.target)) { event.stopImmediatePropagation(); event.target.setCustomValidity(''); }
}, true);
document.addEventListener('change', (event) => { // on Enter, and when a box is left
  if (!isBox(event.target)) return;
  event.stopImmediatePropagation();
  if (!event.target.validity.valid) restore(event.target);
  else if (event.target.value !== event.target.defaultValue) take(event.target, false);
}, true);
document.addEventListener('keydown', (event) => {
  const box = event.target;
  if (!isBox(box) || box.value === box.defaultValue) return;
  if (event.key === 'Escape') restore(box);
  if (!['Enter', 'ArrowUp', 'ArrowDown'].includes(event.key)) return;
  event.stopImmediatePropagation();
  event.preventDefault();
  take(box, true);
}, true);
