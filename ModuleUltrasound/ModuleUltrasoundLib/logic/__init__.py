"""What the panel's steps do, a file a step: lines and the probe's pose in, bone points out. Runs without a widget."""
