# Stands in for the SlicerConfig.cmake of a Slicer build: every macro writes down what it was given, and builds nothing.
# One line a call in ${CRANIONAV_RECORD}: macro|source folder|arguments, separated by ";".

if(NOT DEFINED CRANIONAV_RECORD)
  message(FATAL_ERROR "give -DCRANIONAV_RECORD=<file>")
endif()
file(WRITE "${CRANIONAV_RECORD}" "")

set(Slicer_FOUND TRUE)
set(Slicer_USE_PYTHONQT TRUE)
set(Slicer_USE_FILE "${CMAKE_CURRENT_LIST_DIR}/UseSlicer.cmake")
set(Slicer_EXTENSION_GENERATE_CONFIG "${CMAKE_CURRENT_LIST_DIR}/GenerateConfig.cmake")
set(Slicer_EXTENSION_CPACK "${CMAKE_CURRENT_LIST_DIR}/CPack.cmake")
set(Slicer_QTSCRIPTEDMODULES_LIB_DIR "lib/Slicer-5.8/qt-scripted-modules")
set(Slicer_INSTALL_QTSCRIPTEDMODULES_LIB_DIR "lib/Slicer-5.8/qt-scripted-modules")

function(cranionav_record macro)
  file(APPEND "${CRANIONAV_RECORD}" "${macro}|${CMAKE_CURRENT_SOURCE_DIR}|${ARGN}\n")
endfunction()
