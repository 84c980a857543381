"""Where things lie in the checkout."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
LOGS = ROOT / "mmwave_env" / "data" / "logs"
RECORDINGS = ROOT / "mmwave_env" / "data" / "deepmimo_canyon28"
