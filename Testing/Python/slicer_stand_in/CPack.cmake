# Slicer packs the extension here; the stand-in only notes that it was asked to.
cranionav_record(CPACK)
