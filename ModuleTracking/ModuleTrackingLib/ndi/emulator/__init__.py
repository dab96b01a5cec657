"""An emulated Polaris: the device, the motion that it sees, faults on demand, and the lines that it serves."""
