"""From RF lines to the echo that is the bone, with its probability and its time of flight."""
