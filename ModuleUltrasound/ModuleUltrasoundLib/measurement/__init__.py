"""From echoes to bone points: depth, covariance, quality, speed of sound."""
