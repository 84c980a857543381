"""Pictures of an episode; drawing them takes the extra ``render``."""
