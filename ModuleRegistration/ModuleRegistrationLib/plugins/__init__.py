"""One file a method: surface registration, segmentation."""

DEFAULT_KIND = "registration"
KIND_OF = {"threshold": "segmentation", "gradient": "segmentation"}
