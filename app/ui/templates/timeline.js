// Draws the strips on a canvas, reads the pointer, and asks the server to seek (see viser_adapter.js).
if (!this.isConnected) return; // a copy that the page has dropped already
const shell = this.parentElement, mover = shell.closest('[data-hs-to]'), home = mover.parentElement;
const canvas = shell.querySelector('canvas'), button = shell.querySelector('button');
const pen = canvas.getContext('2d');
for (const old of document.querySelectorAll('body > [data-hs-to]')) if (old.querySelector('.hs-tl')) old.remove();
const HEAD = 20, NAME = 78, VALUE = 72;
let ROW = 17;
const {bad: BAD, good: GOOD, quiet: QUIET, wideFrom: WIDE_FROM} = canvas.dataset;
let d = null, text = '', hover = null, scrubbing = false, said = 0;
const scene = () => [...document.querySelectorAll('canvas')].filter((c) => c !== canvas)
  .sort((a, b) => b.width * b.height - a.width * a.height)[0];

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
  draw();
};
const beyond = (s, v) => s.limit !== null && (s.low ? v < s.limit : v > s.limit);
const columnOf = (frame) => {
  let low = 0, high = d.starts.length;
  while (high - low > 1) { const mid = (low + high) >> 1; if (d.starts[mid] <= frame) low = mid; else high = mid; }
  return low;
};
const say = (text, x, y, colour, align = 'left') => {
  pen.fillStyle = colour; pen.textAlign = align; pen.fillText(text, x, y);
};
function draw() {
  const ratio = window.devicePixelRatio || 1, W = canvas.clientWidth, rows = d ? d.strips.length + 1 : 0;
  ROW = shell.classList.contains('wide') ? 19 : 17;
  const H = HEAD + ROW * rows + 2;
  if (!W) return;
  canvas.style.height = H + 'px';
  if (canvas.width !== Math.round(W * ratio) || canvas.height !== Math.round(H * ratio)) {
    canvas.width = Math.round(W * ratio); canvas.height = Math.round(H * ratio);
  }
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, W, H);
  pen.font = '10.5px system-ui, sans-serif';
  pen.textBaseline = 'middle';
  say('Why did it drift', 8, HEAD / 2, '#e6ebf2');
  if (!d) return;
  const gw = W - NAME - VALUE, C = d.starts.length, X = (frame) => NAME + frame / d.frames * gw;
  const at = columnOf(hover ?? Math.max(d.present, 0)), end = (c) => c + 1 < C ? d.starts[c + 1] : d.frames;
  const first = d.starts[at], last = end(at) - 1, stamp = d.stamps[at];
  const seconds = isNaN(stamp) ? first / d.frames * d.duration : stamp;
  const which = last > first ? `frames ${first.toLocaleString('en')}–${last.toLocaleString('en')}`
    : `frame ${first.toLocaleString('en')}`;
  say(`${which} · ${seconds.toFixed(2)} s`, W - 30, HEAD / 2, hover === null ? QUIET : '#e6ebf2', 'right');
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
    say(isNaN(v) ? '–' : `${v.toFixed(s.digits)} ${s.unit}`, W - 8, mid, beyond(s, v) ? BAD : '#e6ebf2', 'right');
  });
  const top = HEAD + ROW * d.strips.length, mid = top + ROW / 2 - 1, counts = [];
  pen.fillStyle = 'rgba(127,140,160,.09)';
  pen.fillRect(NAME, top, gw, ROW - 2);
  for (const [verdict, colour, mark] of [['candidate', QUIET, '?'], ['rejected', BAD, '×'], ['accepted', GOOD, '✓']]) {
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
  say(counts.join('  ') || '–', W - 8, mid, '#e6ebf2', 'right');
  const bottom = H - 3;
  pen.fillStyle = '#ffd166';
  for (const [frame] of d.notes) pen.fillRect(X(frame + 0.5) - 1, HEAD - 5, 2, 5);
  if (d.present >= 0) {
    pen.fillStyle = '#ffffff';
    pen.fillRect(X(d.present + 0.5) - 0.75, HEAD - 3, 1.5, bottom - HEAD + 3);
  }
  if (hover !== null) {
    pen.fillStyle = 'rgba(255,255,255,.45)';
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
  canvas.dataset.hs = 'seek ' + frame;
  window.hemislamSay({type: 'click', target: canvas});
  delete canvas.dataset.hs;
};
canvas.onpointermove = (event) => {
  if (!d) return;
  const box = canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
  const row = Math.floor((y - HEAD) / ROW), over = x >= NAME && x <= box.width - VALUE;
  const loops = 'Loops by verdict: ✓ accepted, × rejected, ? waiting for others that agree.';
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
const place = (wide) => {
  const over = scene();
  if (wide && over) {
    const box = over.getBoundingClientRect();
    if (mover.parentElement !== document.body) document.body.append(mover);
    Object.assign(mover.style, {position: 'fixed', zIndex: 5, left: box.left + 8 + 'px', width: box.width - 16 + 'px',
      bottom: innerHeight - box.bottom + 8 + 'px'});
  } else {
    if (mover.parentElement !== home) home.append(mover);
    mover.removeAttribute('style');
  }
  shell.classList.toggle('wide', Boolean(wide && over));
  button.textContent = wide ? '⤡' : '⤢';
  button.title = wide ? 'Back under the transport' : 'Along the lower edge of the scene';
  draw();
};
const chosen = () => localStorage.getItem('hemislam-timeline');
const wanted = () => chosen() ? chosen() === 'wide' : Boolean(scene()) && scene().clientWidth >= Number(WIDE_FROM);
button.onclick = () => {
  localStorage.setItem('hemislam-timeline', wanted() ? 'narrow' : 'wide'); place(wanted());
};
new ResizeObserver(draw).observe(shell);
const settle = setInterval(() => {
  if (!home.isConnected) { clearInterval(settle); mover.remove(); return; }
  const over = scene(), box = over && over.getBoundingClientRect();
  const here = box ? [box.left, box.bottom, box.width].join() : '';
  if (here !== shell.dataset.here) { shell.dataset.here = here; place(wanted()); }
}, 300);
const watch = () => {
  const node = document.querySelector('.hs-tl-data');
  if (!node) { if (home.isConnected) setTimeout(watch, 200); return; }
  new MutationObserver(read).observe(node.parentElement, {childList: true});
  read();
};
watch(); draw();
