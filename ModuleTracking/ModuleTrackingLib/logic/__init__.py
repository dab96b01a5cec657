"""What the panel's steps do, a file a step: frames of the tracker in, nodes out. Runs without a widget."""
