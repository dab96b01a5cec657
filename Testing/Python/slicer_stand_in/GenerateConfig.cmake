# Slicer writes the extension's description here; the stand-in writes down what it would hold.
foreach(key HOMEPAGE CATEGORY CONTRIBUTORS DESCRIPTION ICONURL SCREENSHOTURLS DEPENDS)
  if(NOT DEFINED EXTENSION_${key})
    message(FATAL_ERROR "EXTENSION_${key} is not set")
  endif()
  cranionav_record(EXTENSION_${key} "${EXTENSION_${key}}")
endforeach()
