"""Points have a least and a largest size on the screen.

Tests app/export/point_sizes.py; `tests/browser/test_share.py` looks at a page.
"""

from pathlib import Path

import viser

from app.export.point_sizes import VISERS, with_point_sizes

CLIENT = Path(viser.__file__).parent / "client"


def test_viser_still_has_the_line_that_sets_the_size() -> None:
    shader = (CLIENT / "src" / "ThreeAssets.tsx").read_text(encoding="utf-8")
    assert shader.count(VISERS) == 1, "viser's shader sets the size otherwise; points near the camera are discs again"


def test_the_script_comes_before_viser_s_own() -> None:
    page = with_point_sizes((CLIENT / "build" / "index.html").read_text(encoding="utf-8"))
    assert page.index("shaderSource") < page.index("<script", page.index("shaderSource"))
