# cpack: two packages for Debian, `pulmo` with the program, its tools and docs, and `libpulmo-dev` with the library.
# `cmake --workflow --preset debian` configures, builds and packs (docs/packaging.md).
set(CPACK_GENERATOR DEB)
set(CPACK_PACKAGE_NAME pulmo)
set(CPACK_PACKAGE_DESCRIPTION_SUMMARY "Whole human lungs under mechanical ventilation")
set(CPACK_PACKAGE_CONTACT "the pulmo authors")
set(CPACK_PACKAGING_INSTALL_PREFIX /usr)
set(CPACK_STRIP_FILES ON)
set(CPACK_PROJECT_CONFIG_FILE ${CMAKE_CURRENT_LIST_DIR}/check_package.cmake)
set(CPACK_PULMO_ARCH "${PULMO_ARCH}")
set(CPACK_VERBATIM_VARIABLES ON)

# what tools need is written in tools/setup, once
file(READ ${PROJECT_SOURCE_DIR}/tools/setup text)
if(NOT text MATCHES "\n  # plots, meshes, images\n([^)]*)")
  message(FATAL_ERROR "tools/setup has no packages under '# plots, meshes, images'")
endif()
string(REGEX REPLACE "#[^\n]*" "" tools "${CMAKE_MATCH_1}")
separate_arguments(tools UNIX_COMMAND "${tools}")

set(CPACK_DEB_COMPONENT_INSTALL ON)
set(CPACK_COMPONENTS_ALL program development)
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_PACKAGE_SECTION science)

set(CPACK_DEBIAN_PROGRAM_PACKAGE_NAME pulmo)
set(CPACK_COMPONENT_PROGRAM_DESCRIPTION "Alveolar tissue and alveolar air as one finite-strain poroelastic continuum on
a tetrahedral mesh, solved in parallel with PETSc. With meshes, scenes, solver
settings and the tools that make meshes and reports (/usr/share/pulmo).
Compiled for processors of type: ${PULMO_ARCH}.")
set(CPACK_DEBIAN_PROGRAM_PACKAGE_SHLIBDEPS ON)
set(CPACK_DEBIAN_PROGRAM_PACKAGE_DEPENDS openmpi-bin)
list(JOIN tools ", " CPACK_DEBIAN_PROGRAM_PACKAGE_RECOMMENDS)
string(PREPEND CPACK_DEBIAN_PROGRAM_PACKAGE_RECOMMENDS "libopenblas0-pthread, python3, ")

set(CPACK_DEBIAN_DEVELOPMENT_PACKAGE_NAME libpulmo-dev)
set(CPACK_DEBIAN_DEVELOPMENT_PACKAGE_SECTION libdevel)
set(CPACK_COMPONENT_DEVELOPMENT_DESCRIPTION "The library: headers and static library of pulmo for programs that add tissue
laws or effects, with a CMake package (find_package) and a file for pkg-config.
Compiled for processors of type: ${PULMO_ARCH}.")
set(CPACK_DEBIAN_DEVELOPMENT_PACKAGE_DEPENDS
    "petsc-dev, libopenmpi-dev, libhdf5-openmpi-dev, libmetis-dev, libmuparser-dev, pkg-config")
set(CPACK_DEBIAN_DEVELOPMENT_PACKAGE_SUGGESTS "cmake, g++, pulmo")
include(CPack)
