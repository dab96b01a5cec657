"""Landmark and surface registration, their error theory and the verdict on them."""
