# Read by cpack: a package is made for other machines than the one that compiled it.
if(CPACK_PULMO_ARCH STREQUAL "native" AND NOT PULMO_PACKAGE_NATIVE)
  message(FATAL_ERROR "This build is for the processor of this machine (PULMO_ARCH=native), and its program would crash on an "
                      "older one: configure with -DPULMO_ARCH=x86-64-v2, as `cmake --workflow --preset debian` does. "
                      "For machines that are all alike: cpack -D PULMO_PACKAGE_NATIVE=ON")
endif()
