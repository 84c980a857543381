"""What the paper's Sec. II says: motion, measurement, scene, radio and channel."""
