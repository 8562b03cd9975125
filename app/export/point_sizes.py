"""How large viser's page draws points: visible from afar, and no discs right before the camera."""

from typing import Final

LEAST_PX, MOST_PX = 1.5, 12.0
"""Of a point's diameter, on the screen."""
VISERS: Final = "gl_PointSize = (scale / -world_pos.z);"
"""The line of viser's shader that is replaced; `tests/export/test_point_sizes.py` says whether it is still there."""
_SCRIPT: Final = f"""<script>{{
  const compile = WebGL2RenderingContext.prototype.shaderSource;
  WebGL2RenderingContext.prototype.shaderSource = function (shader, text) {{
    const [least, most] = [{LEAST_PX}, {MOST_PX}].map((size) => (size * devicePixelRatio).toFixed(2));
    const line = `gl_PointSize = clamp(scale / -world_pos.z, ${{least}}, ${{most}});`;
    return compile.call(this, shader, text.replace("{VISERS}", line));
  }};
}}</script>"""
_HEAD: Final = "<head>"


def with_point_sizes(page: str) -> str:
    """viser's page, in which points have a least and a largest size."""
    return page.replace(_HEAD, _HEAD + _SCRIPT, 1)
