"""One file a method: surface registration, segmentation."""

# Which kind a file's plugin is, where it is not surface registration
KIND_OF = {"threshold": "segmentation", "gradient": "segmentation"}
