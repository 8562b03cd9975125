"""What the page does where the processor draws what a graphics card should: fewer points, fewer images, sooner.

An image of a map costs such a machine more than all else together, and Chromium lets two or three of them queue, so
a scan was seen up to a second after it was measured. Therefore, there alone:

- What comes is applied at once, not with the next image (which shows points only with the one after it).
- Images are drawn for news and input, not again and again for a quarter of a second after each.
- While the scene changes, at most so many points of the map are drawn, evenly chosen; all of them when it rests.
"""

from typing import Final

MOST_POINTS: Final = 30_000
"""Of the map, in an image of a scene that changes: some 20 ms of a processor. Clouds that just came are drawn whole."""

SCRIPT: Final = (
    """
(() => {
  const MOST = """
    + str(MOST_POINTS)
    + """, NEW_MS = 300, REST_MS = 600, FEW = 500;
  const AGAIN_MS = 150, SETTLE_MS = 400, BEAT_MS = 900;  // images without news: two or three, then one a second
  let slow, news = 0, last = 0, drew = false;
  const now = () => performance.now();
  const GL = WebGL2RenderingContext.prototype;
  const hook = (on, name, wrapped) => {
    const plain = on[name];
    on[name] = function (...given) { return wrapped.call(this, plain, given); };
    return plain;
  };
  hook(HTMLCanvasElement.prototype, 'getContext', function (plain, given) {
    const gl = plain.apply(this, given);
    if (gl instanceof WebGL2RenderingContext && slow === undefined) {
      const about = gl.getExtension('WEBGL_debug_renderer_info');
      slow = !!about && /swiftshader|llvmpipe|basic render/i.test(gl.getParameter(about.UNMASKED_RENDERER_WEBGL));
      // viser's page applies messages as they come where no images are drawn.
      if (slow) Object.defineProperty(document, 'hidden', {get: () => true});
    }
    return gl;
  });

  // News: what the server sends, and what the user does, after which the camera glides on.
  window.Worker = class extends window.Worker {
    constructor(...given) {
      super(...given);
      this.addEventListener('message', (told) => {
        const seen = (message) => !/^Gui|Notification/.test(message.type);  // those of panels are not in the scene
        if (told.data?.type === 'message_batch' && told.data.messages.some(seen)) news = now();
      });
    }
  };
  for (const name of ['pointerdown', 'pointermove', 'wheel', 'keydown', 'resize'])
    addEventListener(name, () => { news = now() + REST_MS; }, {capture: true, passive: true});
  const draws = new WeakSet();
  hook(window, 'requestAnimationFrame', function (plain, [work]) {
    const run = (time) => {
      const wait = news > last ? 0 : now() - news < SETTLE_MS ? AGAIN_MS : BEAT_MS;
      if (slow && draws.has(work) && now() - last < wait) {
        setTimeout(() => plain.call(window, run), 5);
        return;
      }
      const begun = now();
      drew = false;
      work(time);
      if (drew) { draws.add(work); last = begun; }
    };
    return plain.call(window, run);
  });

  // Every k-th point, by steps of k in the buffers; k is odd, since points often come by 32 rings in turn.
  const BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5124: 4, 5125: 4, 5126: 4, 5131: 2};
  const cameAt = new WeakMap(), read = new WeakMap();
  let bound = null, vao = null, newest = 0, counted = 0, before = 0, begun = false;
  hook(GL, 'bindVertexArray', function (plain, given) { vao = given[0]; return plain.apply(this, given); });
  const bind = hook(GL, 'bindBuffer', function (plain, given) {
    if (given[0] === this.ARRAY_BUFFER) bound = given[1];
    return plain.apply(this, given);
  });
  for (const name of ['bufferData', 'bufferSubData'])
    hook(GL, name, function (plain, given) {
      if (given[0] === this.ARRAY_BUFFER && bound) cameAt.set(bound, newest = now());
      return plain.apply(this, given);
    });
  const point = hook(GL, 'vertexAttribPointer', function (plain, given) {
    if (vao) {
      if (!read.has(vao)) read.set(vao, {step: 1, pointers: new Map()});
      const known = read.get(vao);
      known.step = 1;
      known.pointers.set(given[0], [bound, given]);
    }
    return plain.apply(this, given);
  });
  const stepped = (gl, step) => {
    const known = read.get(vao), held = bound;
    const pointers = [...known.pointers.values()].map(
      ([buffer, given]) => [buffer, given, given[4] || given[1] * BYTES[given[2]]]);
    step = Math.min(step, ...pointers.map(([, , bytes]) => Math.floor(255 / bytes)));
    step -= step % 2 === 0;
    if (known.step !== step) {
      for (const [buffer, [at, size, type, normal, , begin], bytes] of pointers) {
        bind.call(gl, gl.ARRAY_BUFFER, buffer);
        point.call(gl, at, size, type, normal, bytes * step, begin);
      }
      bind.call(gl, gl.ARRAY_BUFFER, held);
      known.step = step;
    }
    return step;
  };
  // By where its points are: colours come anew for all of the map.
  const isNew = () => [...read.get(vao).pointers.values()].some(
    ([buffer, given]) => BYTES[given[2]] > 1 && cameAt.get(buffer) > Math.max(newest - NEW_MS, now() - REST_MS));
  hook(GL, 'drawArrays', function (plain, given) {
    drew = true;
    const [mode, first, count] = given;
    const thinned = slow && mode === this.POINTS && count >= FEW && !first && vao && read.has(vao);
    if (!thinned) return plain.apply(this, given);
    if (!begun) {
      begun = true;
      [before, counted] = [counted, 0];
      queueMicrotask(() => { begun = false; });
    }
    const whole = isNew();
    if (!whole) counted += count;
    const wanted = whole || now() - news > REST_MS ? 1 : Math.ceil(before / MOST);
    return plain.call(this, mode, first, Math.ceil(count / stepped(this, wanted + (wanted % 2 === 0))));
  });
  for (const name of ['drawElements', 'drawArraysInstanced', 'drawElementsInstanced'])
    hook(GL, name, function (plain, given) { drew = true; return plain.apply(this, given); });
})();
"""
)


def quickened(page: str) -> str:
    """The page with what it needs where the processor draws; elsewhere it is as it was."""
    return page.replace("<head>", f"<head><script>{SCRIPT}</script>", 1)
