"""What goes to a page's drawing, and when it is drawn: JavaScript that the page's benchmarks begin theirs with."""

WATCH = """
// Calls told(gl, data) for each array of that type and more than `least` numbers on its way to the drawing.
const watchUploads = (type, least, told) => {
  for (const [name, at] of [['bufferData', 1], ['bufferSubData', 2]]) {
    const upload = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...given) {
      const data = given[at];
      if (data instanceof type && data.length > least) told(this, data);
      return upload.apply(this, given);
    };
  }
};
// Calls drawn() once all that was given to the drawing so far is drawn.
const onceDrawn = (gl, drawn) => {
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  const look = () => {
    if (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) { setTimeout(look, 2); return; }
    drawn();
    gl.deleteSync(fence);
  };
  look();
};
"""
