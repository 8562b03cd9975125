"""Limits the size at which viser's page draws points: visible from afar, but no discs right before the camera."""

from typing import Final

LEAST_PX, MOST_PX = 1.5, 12.0
"""Limits of a point's diameter on the screen."""
VISERS: Final = "gl_PointSize = (scale / -world_pos.z);"
"""The replaced line of viser's shader; `tests/export/test_point_sizes.py` checks that it still exists."""
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
    """viser's page with a least and a largest size of points."""
    return page.replace(_HEAD, _HEAD + _SCRIPT, 1)
