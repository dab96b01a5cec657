"""The standalone application: command line and, on top of the same modules, the web workstation."""
