"""Ground floor of CranioNav: what tracking, ultrasound and registration all stand on."""
