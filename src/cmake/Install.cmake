# cmake --install: program, library with its CMake package and its file for pkg-config, tools, docs, manual page. Tools find
# meshes and option files beside them, as in the source tree. Two components: `program`, and `development` for the library.
include(CMakePackageConfigHelpers)
set(package ${CMAKE_INSTALL_LIBDIR}/cmake/pulmo)
set(data ${CMAKE_INSTALL_DATADIR}/pulmo)

# PETSc and MPI may stand where the system's loader does not look
file(RELATIVE_PATH to_libraries ${CMAKE_INSTALL_FULL_BINDIR} ${CMAKE_INSTALL_FULL_LIBDIR})
set_target_properties(pulmo pulmo_library PROPERTIES INSTALL_RPATH_USE_LINK_PATH ON)
set_target_properties(pulmo PROPERTIES INSTALL_RPATH "$ORIGIN/${to_libraries}")

set(CMAKE_INSTALL_DEFAULT_COMPONENT_NAME development)
install(TARGETS pulmo_library EXPORT pulmo)
install(EXPORT pulmo FILE pulmo-targets.cmake NAMESPACE pulmo:: DESTINATION ${package})
configure_package_config_file(${CMAKE_CURRENT_LIST_DIR}/pulmo-config.cmake.in ${PROJECT_BINARY_DIR}/pulmo-config.cmake
                              INSTALL_DESTINATION ${package})
write_basic_package_version_file(${PROJECT_BINARY_DIR}/pulmo-config-version.cmake COMPATIBILITY SameMinorVersion)
install(FILES ${PROJECT_BINARY_DIR}/pulmo-config.cmake ${PROJECT_BINARY_DIR}/pulmo-config-version.cmake
              ${CMAKE_CURRENT_LIST_DIR}/Dependencies.cmake ${CMAKE_CURRENT_LIST_DIR}/FindPETSc.cmake
        DESTINATION ${package})
install(DIRECTORY include/pulmo DESTINATION ${CMAKE_INSTALL_INCLUDEDIR})

# for projects without CMake; what PETSc needs is in PETSc's own file
set(modules ${CMAKE_INSTALL_FULL_LIBDIR}/pkgconfig)
file(RELATIVE_PATH PULMO_TO_PREFIX ${modules} ${CMAKE_INSTALL_PREFIX})
list(TRANSFORM MPI_CXX_INCLUDE_DIRS PREPEND -I OUTPUT_VARIABLE PULMO_MPI_FLAGS)
list(JOIN PULMO_MPI_FLAGS " " PULMO_MPI_FLAGS)
list(JOIN MPI_CXX_LIBRARIES " " PULMO_MPI_LIBRARIES)
configure_file(${CMAKE_CURRENT_LIST_DIR}/pulmo.pc.in ${PROJECT_BINARY_DIR}/pulmo.pc @ONLY)
install(FILES ${PROJECT_BINARY_DIR}/pulmo.pc DESTINATION ${CMAKE_INSTALL_LIBDIR}/pkgconfig)

set(CMAKE_INSTALL_DEFAULT_COMPONENT_NAME program)
install(TARGETS pulmo RUNTIME)
install(DIRECTORY petsc_options meshes DESTINATION ${data})
install(PROGRAMS tools/breathe tools/export tools/report tools/lung_mesh tools/sphere_mesh tools/cell_values tools/accuracy_cost tools/reproduce_paper
        DESTINATION ${data}/tools)
install(DIRECTORY tools/accuracy tools/benchmarks tools/breathing tools/exports tools/meshing tools/paper tools/python tools/reports tools/shared
        DESTINATION ${data}/tools FILES_MATCHING PATTERN "*.py" PATTERN __pycache__ EXCLUDE)
install(DIRECTORY tools/reports/templates DESTINATION ${data}/tools/reports)
install(FILES tools/packaging/slurm/pulmo.sbatch DESTINATION ${data}/tools/packaging/slurm)
install(FILES docs/paper/page.md.in DESTINATION ${data}/docs/paper)
# the tools' build/pulmo is the installed program
file(RELATIVE_PATH to_program ${CMAKE_INSTALL_FULL_DATADIR}/pulmo ${CMAKE_INSTALL_FULL_BINDIR})
install(CODE "file(CREATE_LINK \"${to_program}\" \"\$ENV{DESTDIR}\${CMAKE_INSTALL_PREFIX}/${data}/build\" SYMBOLIC)" COMPONENT program)

# the manual page and the completion of bash, of what the program itself tells
install(CODE "
  set(made \"${PROJECT_BINARY_DIR}/manual\")
  execute_process(COMMAND python3 \"${PROJECT_SOURCE_DIR}/tools/packaging/manual.py\" \"$<TARGET_FILE:pulmo>\" \"\${made}\"
                  RESULT_VARIABLE code ERROR_VARIABLE said)
  if(code EQUAL 0)
    file(INSTALL \"\${made}/pulmo.1\" DESTINATION \"\${CMAKE_INSTALL_PREFIX}/${CMAKE_INSTALL_MANDIR}/man1\")
    file(INSTALL \"\${made}/pulmo.bash\" RENAME pulmo
         DESTINATION \"\${CMAKE_INSTALL_PREFIX}/${CMAKE_INSTALL_DATADIR}/bash-completion/completions\")
  else()
    message(WARNING \"no manual page and no completion: python3 could not ask the program (\${code}) \${said}\")
  endif()" COMPONENT program)

# the Python module stands with the tools that use it; Debian's Python finds it here if the prefix is /usr
set(python_modules lib/python3/dist-packages)
file(RELATIVE_PATH to_module ${CMAKE_INSTALL_PREFIX}/${python_modules} ${CMAKE_INSTALL_FULL_DATADIR}/pulmo/tools/python/pulmo)
install(CODE "file(MAKE_DIRECTORY \"\$ENV{DESTDIR}\${CMAKE_INSTALL_PREFIX}/${python_modules}\")
  file(CREATE_LINK \"${to_module}\" \"\$ENV{DESTDIR}\${CMAKE_INSTALL_PREFIX}/${python_modules}/pulmo\" SYMBOLIC)" COMPONENT program)

install(FILES README.md LICENSE CHANGELOG.md DESTINATION ${CMAKE_INSTALL_DOCDIR})
install(FILES CITATION.cff DESTINATION ${data})
install(DIRECTORY docs/ DESTINATION ${CMAKE_INSTALL_DOCDIR}/docs PATTERN "*.in" EXCLUDE)
