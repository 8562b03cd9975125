// A one-minute tour of the page on the first visit. The element described is outlined; Esc or Skip ends the tour.
const STEPS = [
  ['.hs-steps', '', 'Play, or step', 'Space plays and pauses; ← and → step one frame. Going back keeps the map and your edits.'],
  ['.hs-track', '', 'Go anywhere', 'Drag the track. Its marks show loops, notes and trouble; open Diagnostics to see what the trouble was.'],
  ['[role=slider][aria-valuenow]:not(input)', 'Parameters', 'Tune the ground', 'Move a slider: the map is dimmed and this scan is '
    + 'relabelled at once. Ground is teal; the seeds to which the plane is fitted are amber. Try σ first.', 2],
  ['', 'Loops', 'Judge a loop', 'Where the walk returns to a place, a loop corrects the map. Click its green knob or its row to see '
    + 'the evidence, then Reject it: the yellow line is the path before, and Undo replaces the button.'],
  ['', 'Help', 'That is all', 'Hover over a number to see what it means. This tour and all keys are under Help.'],
];
const seen = () => { try { localStorage.setItem('hemislam-tour', 'seen'); } catch { /* private window */ } };
window.hemislamTour = () => {
  if (document.querySelector('.hs-tour')) return;
  const box = document.createElement('div');
  let at = 0, outlined = null, opened = null;
  const outline = () => { // repeatedly, since viser may rebuild the outlined element
    const [target, , , , place = 0] = STEPS[at], found = target ? document.querySelectorAll(target)[place] : opened;
    if (found !== outlined) outlined?.classList.remove('hs-outlined');
    outlined = found;
    outlined?.classList.add('hs-outlined');
  };
  const timer = setInterval(outline, 500);
  const playing = () => { const now = JSON.parse(document.querySelector('.hs-state').dataset.state); return now.playing && !now.live; };
  const held = playing(); // pause while the user reads
  if (held) hemislamTell('transport', 'pause');
  const end = () => {
    clearInterval(timer); outlined?.classList.remove('hs-outlined'); box.remove(); seen(); window.removeEventListener('keydown', key);
    if (held) hemislamTell('transport', 'resume');
  };
  const key = (event) => { if (event.key === 'Escape') end(); };
  const show = () => {
    const [, tab, title, text] = STEPS[at];
    opened = tab && window.hemislamOpenTab(tab);
    outline();
    box.innerHTML = `<b>${title}</b><p>${text}</p><div class="hs-row"><span class="hs-note">${at + 1} of ${STEPS.length}</span>`
      + '<span><button class="hs-button">Skip</button><button class="hs-button hs-next"></button></span></div>';
    const [skip, next] = box.querySelectorAll('button');
    next.textContent = at + 1 < STEPS.length ? 'Next' : 'Done';
    skip.onclick = end;
    next.onclick = () => { if (at + 1 < STEPS.length) { at += 1; show(); } else { end(); window.hemislamOpenTab('Parameters'); } };
    next.focus();
  };
  box.className = 'hs-tour hs';
  box.setAttribute('role', 'dialog');
  box.setAttribute('aria-label', 'Tour');
  window.addEventListener('keydown', key);
  document.body.append(box);
  show();
};
const first = () => { try { return !localStorage.getItem('hemislam-tour'); } catch { return false; } };
const wait = () => { // until a recording is open
  const node = document.querySelector('.hs-state');
  if (!first() || document.querySelector('.hs-view-only')) return; // a view-only page cannot try these steps
  if (node && JSON.parse(node.dataset.state).open) window.hemislamTour();
  else setTimeout(wait, 1000);
};
setTimeout(wait, 1500);
