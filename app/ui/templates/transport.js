// The bar at the scene's lower edge and the strips above it: draws them, handles the pointer, and sends the user's
// requests to the server (see viser_adapter.js).
const dock = document.querySelector('.hs-dock'), mover = dock.parentElement;
const shell = dock.querySelector('.hs-tl'), canvas = shell.querySelector('canvas'), pen = canvas.getContext('2d');
const bar = dock.querySelector('.hs-transport'), [play, fold, speed] = ['.hs-play', '.hs-fold', '.hs-speed'].map((c) => bar.querySelector(c));
const slider = bar.querySelector('input'), when = bar.querySelector('.hs-when');
const marks = bar.querySelector('.hs-track canvas'), ink = marks.getContext('2d');
const HEAD = 20, NAME = 78, VALUE = 72, ROW = 19, HELD_MS = 1000;
let TEXT, QUIET, GOOD, BAD, NOTE, d = null, text = '', hover = null, scrubbing = false, said = 0, touched = -HELD_MS, covered = -1;
const paint = () => { // in the colours of the theme
  const style = getComputedStyle(dock);
  [TEXT, QUIET, GOOD, BAD, NOTE] = ['text', 'quiet', 'good', 'bad', 'warn'].map((n) => style.getPropertyValue('--hs-' + n));
  draw(); mark();
};
const tell = (word) => hemislamTell('transport', word);

const unpack = (data) => new Float32Array(Uint8Array.from(atob(data), (c) => c.charCodeAt(0)).buffer);
const read = () => {
  const node = document.querySelector('.hs-tl-data');
  if (!node || node.textContent === text) return;
  text = node.textContent;
  d = text ? JSON.parse(text) : null;
  if (d) {
    d.stamps = unpack(d.stamps);
    for (const s of d.strips) s.data = unpack(s.data);
  }
  draw(); mark();
};
const beyond = (s, v) => s.limit !== null && (s.low ? v < s.limit : v > s.limit);
const columnOf = (frame) => d.starts.findLastIndex((start) => start <= frame);
const say = (text, x, y, colour, align = 'left') => {
  pen.fillStyle = colour; pen.textAlign = align; pen.fillText(text, x, y);
};
const cleared = (canvas, pen) => { // in device pixels; returns width and height in CSS pixels
  const ratio = window.devicePixelRatio || 1, W = canvas.clientWidth, H = canvas.clientHeight;
  if (!W) return []; // hidden: leave it unchanged
  canvas.width = Math.round(W * ratio); canvas.height = Math.round(H * ratio);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  return [W, H];
};
function draw() {
  canvas.style.height = HEAD + ROW * (d ? d.strips.length + 1 : 0) + 2 + 'px';
  const [W, H] = cleared(canvas, pen);
  if (!W) return;
  pen.font = '10.5px system-ui, sans-serif';
  pen.textBaseline = 'middle';
  say(d ? 'Diagnostics' : 'Diagnostics appear with the first frame.', 8, HEAD / 2, TEXT);
  if (!d) return;
  const gw = W - NAME - VALUE, C = d.starts.length, X = (frame) => NAME + frame / d.frames * gw;
  const at = columnOf(hover ?? Math.max(d.present, 0)), end = (c) => c + 1 < C ? d.starts[c + 1] : d.frames;
  const first = d.starts[at], last = end(at) - 1, stamp = d.stamps[at];
  const seconds = isNaN(stamp) ? d.start + first / d.frames * d.duration : stamp;
  const which = last > first ? `frames ${first.toLocaleString('en')}–${last.toLocaleString('en')}`
    : `frame ${first.toLocaleString('en')}`;
  say(`${which} · ${seconds.toFixed(2)} s`, W - 8, HEAD / 2, hover === null ? QUIET : TEXT, 'right');
  d.strips.forEach((s, i) => {
    const top = HEAD + ROW * i, base = top + ROW - 2, full = ROW - 4, Y = (v) => base - Math.min(v / s.top, 1) * full;
    pen.fillStyle = 'rgba(127,140,160,.09)';
    pen.fillRect(NAME, top, gw, ROW - 2);
    for (let c = 0; c < C; c++) {
      const low = s.data[c], high = s.data[C + c];
      if (isNaN(high) || (s.bars && high === 0)) continue;
      const x = X(d.starts[c]), w = Math.max(X(end(c)) - x + 0.3, s.bars ? 2 : 1), bad = beyond(s, s.low ? low : high);
      pen.fillStyle = bad ? BAD : s.colour;
      const dim = d.starts[c] > d.present ? 0.4 : 1;
      pen.globalAlpha = (s.bars ? 0.9 : bad ? 0.5 : 0.28) * dim;
      const y = bad && s.low ? base - full : Y(high);
      pen.fillRect(x, y, w, base - y);
      pen.globalAlpha = dim;
      if (!s.bars) pen.fillRect(x, Y(high), w, Math.max(Y(low) - Y(high), 1.3));
    }
    pen.globalAlpha = 1;
    if (s.limit !== null && !s.bars && s.limit > 1e-6 && s.limit < s.top) {
      pen.fillStyle = 'rgba(255,107,107,.55)';
      for (let x = NAME; x < NAME + gw; x += 6) pen.fillRect(x, Y(s.limit), 3, 0.8);
    }
    const v = s.data[s.low ? at : C + at], mid = top + ROW / 2 - 1;
    say(s.name, 8, mid, QUIET);
    say(isNaN(v) ? '–' : s.most && v >= s.most[0] ? s.most[1] : `${v.toFixed(s.digits)} ${s.unit}`, W - 8, mid, beyond(s, v) ? BAD : TEXT, 'right');
  });
  const top = HEAD + ROW * d.strips.length, mid = top + ROW / 2 - 1, counts = [];
  pen.fillStyle = 'rgba(127,140,160,.09)';
  pen.fillRect(NAME, top, gw, ROW - 2);
  for (const [verdict, colour, mark] of [['candidate', NOTE, '?'], ['rejected', QUIET, '×'], ['accepted', GOOD, '✓']]) {
    const found = d.loops[verdict] || [];
    found.forEach((n, c) => {
      if (!n) return;
      pen.globalAlpha = d.starts[c] > d.present ? 0.4 : 1;
      pen.fillStyle = colour;
      const high = verdict === 'accepted' ? ROW - 4 : (ROW - 4) / 2;
      pen.fillRect(X((d.starts[c] + end(c)) / 2) - 1, top + ROW - 3 - high, 2.5, high);
    });
    if (found[at]) counts.push(`${mark} ${found[at]}`);
  }
  pen.globalAlpha = 1;
  say('loops', 8, mid, QUIET);
  say(counts.join('  ') || '–', W - 8, mid, TEXT, 'right');
  const bottom = H - 3;
  pen.fillStyle = NOTE;
  for (const [frame] of d.notes) pen.fillRect(X(frame + 0.5) - 1, HEAD - 5, 2, 5);
  if (d.present >= 0) {
    pen.fillStyle = TEXT;
    pen.fillRect(X(d.present + 0.5) - 0.75, HEAD - 3, 1.5, bottom - HEAD + 3);
  }
  if (hover !== null) {
    pen.fillStyle = QUIET;
    pen.fillRect(X(hover + 0.5) - 0.5, HEAD - 3, 1, bottom - HEAD + 3);
  }
}
const frameAt = (event) => {
  const box = canvas.getBoundingClientRect(), share = (event.clientX - box.left - NAME) / (box.width - NAME - VALUE);
  return Math.min(Math.max(Math.floor(share * d.frames), 0), d.frames - 1);
};
const ask = (frame, now) => {
  if (!now && performance.now() - said < 150) return;
  said = performance.now();
  tell('seek ' + frame);
};
canvas.onpointermove = (event) => {
  if (!d) return;
  const box = canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
  const row = Math.floor((y - HEAD) / ROW), over = x >= NAME && x <= box.width - VALUE;
  const loops = 'Loops by verdict: ✓ accepted, × rejected, ? waiting until others agree.';
  canvas.title = over || row < 0 ? '' : d.strips[row] ? d.strips[row].hint : loops;
  const place = (frame) => NAME + (frame + 0.5) / d.frames * (box.width - NAME - VALUE);
  const near = d.notes.filter(([frame]) => over && Math.abs(place(frame) - x) < 4);
  if (near.length) canvas.title = near.map(([f, text]) => `${f.toLocaleString('en')}: ${text}`).join('\n');
  canvas.style.cursor = over || scrubbing ? 'col-resize' : 'default';
  hover = over || scrubbing ? frameAt(event) : null;
  if (scrubbing) ask(hover, false);
  draw();
};
canvas.onpointerdown = (event) => {
  if (!d || hover === null || event.button) return;
  scrubbing = true; canvas.setPointerCapture(event.pointerId); ask(frameAt(event), true);
};
canvas.onpointerup = (event) => { if (scrubbing) { scrubbing = false; ask(frameAt(event), true); } };
canvas.onpointerleave = () => { if (!scrubbing) { hover = null; draw(); } };
// --- the bar
const mark = () => { // above the track: loops, notes and beginnings of trouble
  const [W, H] = cleared(marks, ink), edge = 8;
  if (!W || !d) return;
  const X = (frame) => edge + (frame + 0.5) / d.frames * (W - 2 * edge);
  const bar = (frame, colour, high) => { ink.fillStyle = colour; ink.fillRect(X(frame) - 1.25, 0, 2.5, high); };
  const lines = (colour, points, fill) => { // distinguished by shape as well as by colour
    ink.beginPath();
    points.forEach(([x, y, move], i) => { if (i && !move) ink.lineTo(x, y); else ink.moveTo(x, y); });
    if (fill) { ink.fillStyle = colour; ink.fill(); } else { ink.strokeStyle = colour; ink.lineWidth = 1.5; ink.stroke(); }
  };
  const bad = d.starts.map((_, c) => d.strips.some((s) => s.name !== 'frame time' && beyond(s, s.data[s.low ? c : d.starts.length + c])));
  d.starts.forEach((start, c) => { if (bad[c] && !bad[c - 1]) lines(BAD, [[X(start) - 5, H], [X(start) + 5, H], [X(start), H - 8]], true); });
  const each = (verdict, draw) => (d.loops[verdict] || []).forEach((n, c) => { if (n) draw(d.starts[c]); });
  each('rejected', (frame) => { const x = X(frame); lines(QUIET, [[x - 3, 1], [x + 3, 7], [x - 3, 7, 1], [x + 3, 1]]); });
  each('accepted', (frame) => bar(frame, GOOD, 8));
  for (const [frame] of d.notes) bar(frame, NOTE, H);
};
const PAUSE = 'M6 5h4v14H6zM14 5h4v14h-4z', PLAY = play.querySelector('path').getAttribute('d');
const show = () => {
  const node = document.querySelector('.hs-state');
  dock.hidden = false;
  const now = JSON.parse(node.dataset.state), held = performance.now() - touched < HELD_MS;
  when.innerHTML = now.words;
  slider.max = now.last;
  if (!held) slider.value = now.frame;
  slider.setAttribute('aria-valuenow', slider.value);
  speed.firstElementChild.textContent = now.speed;
  bar.style.setProperty('--hs-done', `${100 * now.done}%`);
  play.querySelector('path').setAttribute('d', now.playing ? PAUSE : PLAY);
  play.setAttribute('aria-label', now.playing ? 'Pause' : 'Play');
  for (const part of bar.querySelectorAll('button,input')) part.disabled = !now.open;
  fold.disabled = false;
  for (const part of bar.querySelectorAll('.hs-past')) part.hidden = now.live;
};
const dragged = (event) => { touched = performance.now(); ask(Number(slider.value), event.type === 'change'); };
slider.oninput = slider.onchange = dragged;
bar.onpointerup = () => document.activeElement.blur(); // so that keys act on the scene, and no focus ring shows
speed.addEventListener('click', (event) => { if (event.target.dataset.hs) speed.open = false; });
window.addEventListener('pointerdown', (event) => { if (!speed.contains(event.target)) speed.open = false; });
const unfold = (open) => {
  shell.hidden = !open;
  fold.setAttribute('aria-expanded', open);
  localStorage.setItem('hemislam-diagnostics', open ? 'open' : '');
  draw();
};
fold.onclick = () => unfold(shell.hidden);
const settle = () => {
  const scene = document.querySelector('canvas[data-engine]');
  if (!scene || dock.hidden) return;
  const box = scene.getBoundingClientRect(), phone = innerWidth < 577;
  Object.assign(mover.style, {position: 'fixed', zIndex: 11, left: box.left + (phone ? 0 : 8) + 'px',
    width: box.width - (phone ? 0 : 16) + 'px', bottom: phone ? 0 : innerHeight - box.bottom + 8 + 'px'});
  dock.classList.toggle('narrow', box.width < 800); dock.classList.toggle('wrapped', box.width < 700);
  const sheet = phone && document.querySelector('[style*="max-height: 60%"]'), high = dock.offsetHeight;
  const style = document.documentElement.style;
  const put = (name, pixels) => { if (style.getPropertyValue(name) !== pixels + 'px') style.setProperty(name, pixels + 'px'); };
  put('--hs-beside', innerWidth - box.right); put('--hs-bar', high); put('--hs-under', high + (sheet ? sheet.offsetHeight : 0));
  const above = box.bottom + 8 - dock.getBoundingClientRect().top, hidden = Math.round(100 * Math.max(0, above / box.height) || 0);
  if (hidden !== covered) { covered = hidden; hemislamTell('camera', 'cover ' + hidden); }
};
new ResizeObserver(paint).observe(dock);
const watch = (name, act) => { // also after viser has made the panel again, as for another server
  let place = null;
  setInterval(() => {
    const node = document.querySelector(name);
    if (!node || node.parentElement === place) return;
    place = node.parentElement; covered = -1;
    new MutationObserver(() => { if (document.querySelector(name)) act(); }).observe(place, {childList: true});
    act();
  }, 200);
};
new MutationObserver(paint).observe(document.documentElement, {attributes: true});
const copy = (name) => () => { dock.querySelector(name).innerHTML = document.querySelector(name + '-data').innerHTML; };
watch('.hs-scale-data', copy('.hs-scale'));
// The ends of the colour bar. The legend is not replaced while one is dragged; later, a focused end keeps its focus.
const legend = dock.querySelector('.hs-legend'), ends = () => [...legend.querySelectorAll('input')];
let spread = false;
const explain = () => {
  if (spread) return;
  const focus = ends().indexOf(document.activeElement);
  copy('.hs-legend')();
  if (focus >= 0 && ends()[focus]) ends()[focus].focus();
};
const choose = (at) => hemislamTell('legend', `ends ${Math.min(...at)} ${Math.max(...at)}`);
legend.onpointerdown = () => { spread = true; window.addEventListener('pointerup', () => { spread = false; }, {once: true}); };
legend.onchange = () => { choose(ends().map((end) => Number(end.value))); setTimeout(explain, 600); };
legend.ondblclick = () => choose([0, 100]);
watch('.hs-legend-data', explain);
watch('.hs-tl-data', read); watch('.hs-state', show); unfold(localStorage.getItem('hemislam-diagnostics') === 'open');
setInterval(settle, 300);
