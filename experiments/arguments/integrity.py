"""Options of commands that tell whether errors stay below what covariances promise."""

from dataclasses import dataclass
from pathlib import Path

from mmwave_env.localization.protection import ALERT_LIMIT_M, RISK


@dataclass(kw_only=True)
class IntegrityArgs:
    """Integrity."""

    risk: float = RISK
    """that an error exceeds its protection level, if covariances are right"""
    stanford: Path | None = None
    """draw errors against protection levels, a Stanford diagram, to this .png, .svg or .pdf file"""
    alert_limit: float = ALERT_LIMIT_M
    """protection level above which positions are not to be used, m, in that diagram"""
