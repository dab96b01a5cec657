"""The web workstation: the modules' panels and Slicer's own views in a browser."""
