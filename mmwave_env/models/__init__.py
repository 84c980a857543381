"""Models of the paper's Sec. II: motion, measurement, scene, radio and channel."""
