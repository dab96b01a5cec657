"""What the panel's steps do, a file a step: nodes in, arrays to the library, results to nodes. Runs without a widget."""
