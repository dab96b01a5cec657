"""Pulser/receivers: the plugin kind, what drivers share, lines to the main thread and to a file."""
