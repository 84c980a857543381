"""The figures that the paper prints (arXiv 2510.06861)."""

from typing import NamedTuple


class Published(NamedTuple):
    """A row of Table I or II."""

    # ate_m, rpe_m, nees, rmse_m: as printed, in that order
    ate_m: float
    rpe_m: float
    nees: float
    rmse_m: float


LOW_MOBILITY = {  # Table I
    "EKF": Published(0.67, 0.10, 2.40e-4, 0.30),
    "UKF": Published(0.35, 0.11, 6779.6, 0.22),
    "CKF": Published(2.72, 0.11, 2.06e5, 1.24),
    "optimized": Published(0.19, 0.02, 0.75, 0.06),
}
HIGH_MOBILITY = {  # Table II
    "EKF": Published(158.3, 2.751, 1704.3, 198.76),
    "UKF": Published(8.69, 33.99, 5.08e5, 22.32),
    "CKF": Published(12.868, 4.684, 2.59e7, 47.72),
    "optimized": Published(1.74, 0.17, 1.36e5, 0.60),
}
OTHERS = {  # Table III: method, scenario, ATE in meters
    "Indoor mmWave (Karttunen et al. 2025)": ("indoor", "0.2 to 0.3"),
    "RadarSLAM (Hong et al. 2020)": ("outdoor, adverse", "5 to 13"),
}
