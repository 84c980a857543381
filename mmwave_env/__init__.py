"""MmWaveLoc-v0: an agent chooses which Kalman filter pipeline localizes a mobile user.

Importing this package only registers the environment; heavy packages load when it is made.
"""

import gymnasium

__version__ = "0.1.0"

gymnasium.register(
    id="MmWaveLoc-v0",
    entry_point="mmwave_env.env:MmWaveLocEnv",
    vector_entry_point="mmwave_env.vector_env:MmWaveLocVectorEnv",
)
