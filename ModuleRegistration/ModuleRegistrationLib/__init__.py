"""From a head CT to a verified registration: anatomy, registration, verification. Pure Python, no MRML, no Qt."""
