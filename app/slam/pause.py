"""A pause of both sensors in the middle of a recording, as when the recorder was paused: the local map begins anew.

How the device moved meanwhile is unknown. The pose continues from the last one, with the tilt that the accelerometer
shows; loops then tie the new map to what was mapped before. At first, the acceleration of walking hides gravity. Once
the filter knows gravity's direction, odom is levelled, the map begins once more, and keyframes resume.
"""

from dataclasses import dataclass, replace

import numpy as np

from app.slam import coast, lie
from app.slam.imu import BA, BG, DIM, EXT, GRAV, KNOWN, POS, ROT, VEL, WALKING, Belief, seen_from_the_lidar
from app.slam.kernels import manifold
from app.slam.params import Params
from app.slam.start import BEFORE_NS
from app.slam.types import ImuSamples, Scan

PAUSE_S = 1.5
"""Longest gap in both scans and IMU samples that is not a pause: the motion is bridged to within centimetres."""
TILTED = 0.15
"""rad: standard deviation of the direction of gravity as a walking person's accelerometer shows it in one scan."""
SETTLED_S = 2.0
"""Duration of four steps. By then the filter knows the direction of gravity to about a degree."""
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Interruption:
    """Attributes:
    seconds: without anything measured. begin_ns: when it began. end_ns: when the scans went on.
    """

    seconds: float
    begin_ns: int
    end_ns: int


def before(scan: Scan, samples: ImuSamples, last_ns: int) -> Interruption | None:
    """The pause between the end of the last scan and this one, if there is one."""
    inside = (samples.stamps_ns > last_ns) & (samples.stamps_ns < scan.stamp_ns)
    known = np.concatenate([[last_ns], samples.stamps_ns[inside], [scan.stamp_ns]])
    blanks = np.diff(known)
    longest = int(blanks.argmax())
    seconds = float(blanks[longest]) * 1e-9
    return Interruption(seconds, int(known[longest]), scan.stamp_ns) if seconds > PAUSE_S else None


def is_over(pause: Interruption, now_ns: int) -> bool:
    """Whether odom can be levelled, and keyframes can resume."""
    return now_ns - pause.end_ns > SETTLED_S * 1e9


def resumed(
    last: Belief, pause: Interruption, scan: Scan, samples: ImuSamples, params: Params
) -> tuple[Belief, ImuSamples]:
    """The belief at the beginning of the scan, and the samples to continue with: those after the pause.

    What is known about the sensors is kept. While the IMU is silent, its earlier samples are returned. If there is no
    IMU, the rate of turn, which stands in for the gyroscope's bias (`coast`), is unknown again.
    """
    state, later = last.state, samples.stamps_ns > max(pause.begin_ns, scan.stamp_ns - BEFORE_NS)
    sigma = np.zeros(DIM)
    sigma[ROT] = sigma[POS] = KNOWN
    sigma[VEL], sigma[GRAV] = WALKING, TILTED
    if later.any():
        samples = samples.part(later)
        up = samples.accel.mean(axis=0) - state.b_accel
    else:
        up = coast.begin(scan, params).state.R_odom_imu[2]
    covariance = np.diag(sigma**2)
    sensors = np.r_[BG, BA, EXT]
    covariance[np.ix_(sensors, sensors)] = last.covariance[np.ix_(sensors, sensors)]
    here = replace(
        state,
        stamp_ns=scan.stamp_ns,
        R_odom_imu=lie.between(state.R_odom_imu @ up, UP) @ state.R_odom_imu,
        v_odom_imu=np.zeros(3),
        g_odom=-np.linalg.norm(state.g_odom) * UP,
    )
    belief = Belief(here, covariance)
    if params.filter.estimate_extrinsics:
        belief = seen_from_the_lidar(belief)
    return (belief if len(samples) else coast.without_imu(belief)), samples


def levelled(belief: Belief) -> Belief:
    """The same, with odom turned about the device's position so that gravity points straight down."""
    state = belief.state
    turn = lie.between(-state.g_odom, UP)
    down = turn @ state.g_odom
    change = np.eye(DIM)
    change[POS, POS] = change[VEL, VEL] = turn
    change[GRAV, GRAV] = manifold.tangent_basis(down).T @ turn @ manifold.tangent_basis(state.g_odom)
    level = replace(state, R_odom_imu=turn @ state.R_odom_imu, v_odom_imu=turn @ state.v_odom_imu, g_odom=down)
    return Belief(level, change @ belief.covariance @ change.T)
