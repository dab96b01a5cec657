"""Where to palpate next, how to hold the probe, and which lines become points."""
