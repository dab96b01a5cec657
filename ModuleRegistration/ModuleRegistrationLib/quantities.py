"""What a registration is judged by: the quantities' names, as tables, panel and files have them."""

from __future__ import annotations

QUANTITY, VALUE = "quantity", "value"
METHOD, STATUS, MESSAGE = "method", "status", "message"
FRE, FLE = "FRE (mm, RMS of the landmarks)", "landmark error FLE (mm, RMS, estimated)"
POINTS_USED, POINTS_REJECTED = "points used", "points rejected"
SURFACE_RMS, SPEED = "surface residual (mm, RMS)", "speed of sound (m/s)"
PREDICTED_MEAN, PREDICTED_P95 = "predicted TRE (mm, mean over targets)", "predicted TRE (mm, 95%, worst target)"
TRE_MEAN, TRE_SD, TRE_MAX = "TRE (mm, mean)", "TRE (mm, SD)", "TRE (mm, max)"
PLAUSIBILITY_MEAN, PLAUSIBILITY_MAX = "plausibility distance (mm, mean)", "plausibility distance (mm, max)"
TOUCHED, HELD_OUT = "plausibility points", "held-out points"  # beside what the stated error lets expect of them
INFLUENTIAL, BELOW_LIMIT = "most influential point", "probability of a TRE below the limit, worst target"
