# What pulmo links with; MPI, HDF5 and METIS are those that PETSc was built with, as far as its makefiles tell.
# Used by pulmo's own build and by those who find an installed pulmo.
include(${CMAKE_CURRENT_LIST_DIR}/FindPETSc.cmake)

if(NOT MPI_CXX_COMPILER)
  pkg_get_variable(PETSC_CXX_COMPILER ${PETSC_MODULE_NAME} cxxcompiler)
  if(PETSC_CXX_COMPILER MATCHES "mpi[^/]*$") # a wrapper; a plain compiler says nothing of MPI
    find_program(PETSC_MPI_WRAPPER ${PETSC_CXX_COMPILER})
    mark_as_advanced(PETSC_MPI_WRAPPER)
    if(PETSC_MPI_WRAPPER)
      set(MPI_CXX_COMPILER "${PETSC_MPI_WRAPPER}" CACHE FILEPATH "MPI's compiler wrapper: PETSc's")
    endif()
  endif()
endif()
if(NOT MPIEXEC_EXECUTABLE)
  petsc_variable(MPIEXEC launcher)
  string(REGEX REPLACE " .*" "" launcher "${launcher}")
  if(launcher MATCHES "/mpiexec[^/]*$" AND EXISTS "${launcher}")
    set(MPIEXEC_EXECUTABLE "${launcher}" CACHE FILEPATH "MPI's launcher: PETSc's")
  endif()
endif()
find_package(MPI REQUIRED COMPONENTS CXX)

# A package of PETSc's own folders if PETSc names any, else of the system's.
macro(find_petsc_package name header library)
  petsc_package_folders(${name} ${name}_HEADER_HINTS ${name}_LIBRARY_HINTS)
  find_path(${name}_INCLUDE_DIR ${header} PATHS ${${name}_HEADER_HINTS} NO_DEFAULT_PATH)
  find_library(${name}_LIBRARY NAMES ${library} PATHS ${${name}_LIBRARY_HINTS} NO_DEFAULT_PATH)
  find_path(${name}_INCLUDE_DIR ${header} HINTS ${PETSC_INCLUDE_DIRS} PATH_SUFFIXES hdf5/openmpi REQUIRED)
  find_library(${name}_LIBRARY NAMES ${ARGN} ${library} HINTS ${PETSC_LIBRARY_FOLDER} REQUIRED)
  mark_as_advanced(${name}_INCLUDE_DIR ${name}_LIBRARY)
  if(NOT TARGET pulmo::${name})
    add_library(pulmo::${name} INTERFACE IMPORTED GLOBAL)
    set_target_properties(pulmo::${name} PROPERTIES INTERFACE_LINK_LIBRARIES "${${name}_LIBRARY}"
                                                    INTERFACE_INCLUDE_DIRECTORIES "${${name}_INCLUDE_DIR}")
  endif()
endmacro()
find_petsc_package(METIS metis.h metis)
find_petsc_package(HDF5 hdf5.h hdf5 hdf5_openmpi)

# expressions of users; only pulmo's own sources see its headers
find_path(MUPARSER_INCLUDE_DIR muParser.h)
find_library(MUPARSER_LIBRARY muparser)
mark_as_advanced(MUPARSER_INCLUDE_DIR MUPARSER_LIBRARY)
if(NOT MUPARSER_INCLUDE_DIR OR NOT MUPARSER_LIBRARY)
  message(FATAL_ERROR "pulmo needs muparser (Debian: libmuparser-dev); where it stands elsewhere, set MUPARSER_INCLUDE_DIR "
                      "(the folder of muParser.h) and MUPARSER_LIBRARY.")
endif()
if(NOT TARGET pulmo::muparser)
  add_library(pulmo::muparser INTERFACE IMPORTED GLOBAL)
  set_target_properties(pulmo::muparser PROPERTIES INTERFACE_LINK_LIBRARIES "${MUPARSER_LIBRARY}"
                                                   INTERFACE_INCLUDE_DIRECTORIES "${MUPARSER_INCLUDE_DIR}")
endif()

# one MPI for all: PETSc's headers know theirs, HDF5's must be parallel
if(NOT PULMO_CHECKED_LIBRARIES)
  set(source ${CMAKE_BINARY_DIR}/CMakeFiles/pulmo_libraries.cpp)
  file(WRITE ${source} "#include <petscsys.h>\n#include <hdf5.h>\n#include <metis.h>\n#ifndef H5_HAVE_PARALLEL\n#error HDF5 is not parallel\n#endif\n"
                       "int main(int n, char **words)\n{\n  idx_t options[METIS_NOPTIONS];\n  return PetscInitialize(&n, &words, nullptr, nullptr) + METIS_SetDefaultOptions(options) + H5open() + PetscFinalize();\n}\n")
  try_compile(PULMO_LIBRARIES_MATCH ${CMAKE_BINARY_DIR}/CMakeFiles/pulmo_libraries SOURCES ${source}
              LINK_LIBRARIES pulmo::METIS PETSc::PETSc MPI::MPI_CXX pulmo::HDF5 OUTPUT_VARIABLE output)
  if(NOT PULMO_LIBRARIES_MATCH)
    message(FATAL_ERROR "PETSc ${PETSC_VERSION} does not compile with this MPI (${MPI_CXX_COMPILER}), HDF5 "
                        "(${HDF5_LIBRARY}) and METIS (${METIS_LIBRARY}): set MPI_CXX_COMPILER, HDF5_INCLUDE_DIR, HDF5_LIBRARY, "
                        "METIS_INCLUDE_DIR and METIS_LIBRARY to those that PETSc was built with.\n${output}")
  endif()
  set(PULMO_CHECKED_LIBRARIES TRUE CACHE INTERNAL "PETSc, MPI, HDF5 and METIS go together")
endif()
