"""What is said of a comparison, as HTML."""

from html import escape

import numpy as np

from app.server.follower import same_recording
from app.server.protocol import Snapshot
from app.slam.types import I64
from app.ui.colours import LABEL_COLOURS
from app.ui.compare_maths import A_COLOUR, B_COLOUR, Difference, Ground
from app.ui.html import BAD, WARN, box, dot, heading, number, tile, tiles


def status(a: Snapshot | None, b: Snapshot | None, names: tuple[str, str], forked_at: int) -> str:
    """Who A and B are, and how B gets on; without a fork, what one is for."""
    if a is None or b is None:
        return box(
            "<b>Fork here</b> goes on from this frame twice: as it is, A, and with other parameters, B, side by side."
        )
    who = f'<div class="hs-keys">{dot(A_COLOUR, f"A · {names[0]}")}{dot(B_COLOUR, f"B · {names[1]}")}</div>'
    text, colour = how(a, b)
    style = f' style="color:{colour}"' if colour else ""
    return box(who, f'<div class="hs-note"{style}>{escape(text)}</div>' if text else "", f"forked at {forked_at:,}")


def how(a: Snapshot, b: Snapshot) -> tuple[str, str]:
    """How B gets on in a sentence, and its colour."""
    if not b.engine_alive:
        return "B's engine has ended; A is not touched. Keep what B has, or discard it.", BAD
    if b.progress is not None:
        share = b.progress.fraction
        return b.progress.title + (f" · {100 * share:.0f} %" if np.isfinite(share) else " …"), WARN
    if b.recording is None:
        return "B is starting …", WARN
    if not same_recording(a, b):
        return "A has another recording open; B stays where it is.", WARN
    behind = a.transport.frame - b.transport.frame
    trouble = next((notice.text for notice in reversed(b.notices) if notice.level == "error"), "")
    if abs(behind) > 1:
        return f"B is {abs(behind):,} frames {'behind' if behind > 0 else 'ahead'}. {trouble}".strip(), WARN
    return (f"B: {trouble}", BAD) if trouble else ("", "")


def legend() -> str:
    """Of the scan's colours."""
    keys = (
        dot(A_COLOUR, "ground only in A"),
        dot(B_COLOUR, "only in B"),
        dot(LABEL_COLOURS[1], "both"),
        dot(LABEL_COLOURS[0], "neither"),
    )
    return box(f'<div class="hs-keys hs-note">{"".join(keys)}</div>')


def numbers(found: Difference, counts: I64 | None) -> str:
    """The newest common frame: how far apart, whose ground, how long and how wrong.

    Args:
        counts: points by `Ground`; None while there is no frame that both have.
    """
    if not len(found):
        return ""
    worst = f"most {number(100 * float(found.position_m.max()), 1)} cm"
    turned = found.turn_deg[np.isfinite(found.turn_deg)]
    most = f"most {number(float(turned.max()) if len(turned) else np.nan)}°"
    apart = tiles(
        (
            tile("A to B", number(100 * float(found.position_m[-1]), 1), "cm", note=worst, width="half"),
            tile("turned", number(float(found.turn_deg[-1])), "°", note=most, width="half"),
        )
    )
    ground, parts = "", []
    if counts is not None:
        alone = f"{counts[Ground.ALONE]:,} points of A's scan are not in B's" if counts[Ground.ALONE] else ""
        ground = heading("Points called ground") + tiles(
            (
                tile("only in A", f"{counts[Ground.ONLY_A]:,}"),
                tile("only in B", f"{counts[Ground.ONLY_B]:,}"),
                tile("in both", f"{counts[Ground.BOTH]:,}", note=alone),
            )
        )
    for title, (a, b), unit, scale in (
        ("frame, mean of A → B", found.total_ms, "ms", 1.0),
        ("error to truth, RMS of A → B", found.error_m, "cm", 100.0),
    ):
        known = np.isfinite(a) & np.isfinite(b)
        if known.any():
            mean = [_mean(column[known], scale, squared=unit == "cm") for column in (a, b)]
            parts.append(tile(title, f"{number(mean[0], 1)} → {number(mean[1], 1)}", unit, width="wide"))
    return apart + ground + heading("Time and error") + tiles(parts)


def _mean(values: np.ndarray, scale: float, *, squared: bool) -> float:
    return scale * float(np.sqrt(np.mean(values**2)) if squared else np.mean(values))
