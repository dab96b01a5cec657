"""What the CT holds: volume, bone surface, titanium spheres, landmarks."""
