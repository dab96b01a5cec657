"""The page's own words, in one place. Those of a step's fields and buttons stand in its module's panel description."""

from __future__ import annotations

TITLE = "CranioNav"
DISCLAIMER = "Research software, not a medical device"
SIMULATED = "Simulated patient"

# The open step
NEXT_STEP = "Next step: {title}"
FIRST = "First:"
DONE = "Done."
NOW, SEE_BELOW = "Now: ", "see below"
OPEN_FILE = "Open"
RESUMING = "Bringing back the session …"
UNSAVED = "Nothing is being saved; start the workstation with a folder that can be written to (--case):"
DETAILS, SETTINGS, CANCEL = "Details", "Settings", "Cancel"

# Title bar and keys
KEYS, KEYS_HINT, EVERY_STEP = "Keys", "Keys (?)", "every step"
WINDOW_HINT = "Grey window for {title} (W: the next)"
NEXT_WINDOW = "Next grey window: {titles}"
DRAG_WINDOW = "Dragging in a slice sets the grey window, or no longer"
RESET = "Reset all views"
ERROR_COLORS = "In colours: expected error on the skull, distance of the bone points, or nothing"
SOUNDS = "Sounds on or off"
BRIGHT_KEY, BRIGHT = "Enter", "Press the bright button: the thing to do now"
TAB_KEYS, TAB = "Tab, Shift+Tab", "To the next button, field, list or view, or back; Enter or Space presses it, arrows choose"
STEP_ON, STEP_BACK, SHOW_KEYS = "Next step", "Step before", "Show or hide this list"
MOVE_KEYS = "Arrows, Page up/down"
MOVE = "Move the slices by 1 mm (Shift: 10 mm), where the step itself has no use for the key"
TURN_KEYS, TURN = "J, L, I, K", "Look at the head in 3-D from further left, right, above, below"
SIZE_KEYS, SIZE = "+, -", "All views larger, or smaller"
LAYOUTS = {
    "four": "Four views",
    "wide": "Large 3-D, slices beside it",
    "3d": "3-D only",
    "axial": "Large axial slice",
    "sagittal": "Large sagittal slice",
    "coronal": "Large coronal slice",
}
WINDOWS = {"bone": "Bone", "brain": "Brain", "skin": "Skin"}

# Over the views
SOLID = "3-D"
SIDES = {  # left, right, top and bottom of a slice as radiology shows it
    "Axial": ("R", "L", "A", "P"),
    "Coronal": ("R", "L", "S", "I"),
    "Sagittal": ("A", "P", "S", "I"),
}
EXPECTED_ERROR, WITH_POINTS = "Expected error, 95 %", "expected with the points taken: {count}"
BONE_POINTS, LEFT_OUT = "Bone points: distance to the bone", "crosses: {count} left out"
SCALE_END = "≥ {most:g} mm"
PICTURE_OLD = "picture {seconds} s old"

# Live drawings
A_LINE, A_LINE_HINT = "A-line", "A-line; the light band is the gate"
SKIN, BONE = "skin", "bone"
TILT_OF_PROBE = "Tilt of the probe"
