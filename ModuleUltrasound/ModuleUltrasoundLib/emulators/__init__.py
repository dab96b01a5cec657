"""Stand-ins for A-mode devices, to run in a process of their own: `python -m ModuleUltrasoundLib.emulators`."""
