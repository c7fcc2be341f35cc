"""The walk cycle of an average adult: measured curves over one stride, and body dimensions.

The curves are the mean of six strides (CMU motion capture database, subject 02, trials 01 and 02,
floor tilt removed), as Fourier series over the phase 0..1 of a stride. Phase 0 is the touchdown of
the ball of the foot; the other foot is half a stride later.
"""

import numpy as np

THIGH, SHIN, FOOT = 0.43, 0.41, 0.126  # m; the foot is from ankle to ball
STRIDE, PERIOD = 1.47, 1.05  # m and s, of two steps
ANKLE_HEIGHT, BALL_HEIGHT = 0.085, 0.045  # m above the sole of a flat foot
HEEL = 0.05  # m behind the ankle
HALF_PELVIS, HIP_DROP = 0.09, 0.05  # m from pelvis to hip, sideways and down
FLAT = -np.arcsin((ANKLE_HEIGHT - BALL_HEIGHT) / FOOT)  # rad, ankle to ball, of a flat foot
BALL_OFF, HEEL_ON = 0.45, 0.88  # phases of ball lift-off and heel strike
PHASE_OFFSETS = (0.0, 0.5)  # of each foot, left first

# Mean, then cosine and sine coefficient of each harmonic.
HIP = (  # degrees, thigh forward of vertical
    12.086, (22.070, -13.118), (-4.958, 2.500), (2.033, -0.540), (0.426, 0.561), (0.210, 0.064)
)  # fmt: skip
ABDUCTION = (  # degrees, thigh outward
    -5.410, (-2.244, -2.275), (-0.565, 0.645), (0.222, -0.444), (-0.254, -0.046), (-0.070, -0.019)
)  # fmt: skip
KNEE = (  # degrees, 0 is straight
    37.680, (-1.385, -17.136), (-5.922, 17.120), (5.318, -0.832), (1.985, 1.240), (0.445, -0.259)
)  # fmt: skip
PITCH = (  # degrees, ankle to ball above horizontal
    -32.259, (30.848, 11.346), (-4.487, -20.753), (-4.462, 3.073), (-1.292, -2.621), (-2.124, 1.812)
)  # fmt: skip
HEIGHT = (0.925, (0.0, 0.0), (-0.012, 0.001), (-0.001, 0.0), (-0.003, 0.0))  # m, of the pelvis
PITCH_SD, HEIGHT_SD = np.radians(4.1), 0.01  # rad and m, standard deviation over strides


def curve(series: tuple, phase: np.ndarray) -> np.ndarray:
    """A measured curve, in its table's unit, at phases of any stride."""
    mean, *harmonics = series
    angle = 2.0 * np.pi * phase
    return mean + sum(
        a * np.cos(j * angle) + b * np.sin(j * angle) for j, (a, b) in enumerate(harmonics, 1)
    )


def ball(phase: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The ball of the foot, m: ahead of the pelvis, above the floor, and outward of its stance."""
    hip, knee, pitch = (np.radians(curve(series, phase)) for series in (HIP, KNEE, PITCH))
    ahead = THIGH * np.sin(hip) + SHIN * np.sin(hip - knee) + FOOT * np.cos(pitch)
    below = THIGH * np.cos(hip) + SHIN * np.cos(hip - knee) - FOOT * np.sin(pitch)
    outward = np.sin(np.radians(curve(ABDUCTION, phase) - curve(ABDUCTION, np.full(1, 0.2))))
    return ahead, curve(HEIGHT, phase) - HIP_DROP - below, (THIGH + SHIN) * outward
