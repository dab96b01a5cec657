"""A-mode ultrasound: lines, echoes, depth, quality, probe guidance, palpation. Pure Python, no MRML, no Qt."""
