"""One file an A-mode device."""
