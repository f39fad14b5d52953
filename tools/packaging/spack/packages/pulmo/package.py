"""Spack's recipe for pulmo, of a folder with its source: there is no archive to fetch yet.

    spack repo add SOURCE/tools/packaging/spack
    spack env activate --create pulmo
    spack add pulmo
    spack develop --path SOURCE pulmo@=0.1.0
    spack install
"""
from spack.package import *


class Pulmo(CMakePackage):
    """Whole human lungs under mechanical ventilation: alveolar tissue and alveolar air as one finite-strain poroelastic
    continuum on a tetrahedral mesh, solved in parallel with PETSc."""

    license("BSD-2-Clause")
    version("0.1.0")

    depends_on("c", type="build")
    depends_on("cxx", type="build")
    depends_on("cmake@3.25:", type="build")
    depends_on("pkgconfig", type="build")
    depends_on("python@3.9:", type="build")  # manual page, completion of bash
    depends_on("mpi")
    depends_on("petsc@3.18:3.25 +mpi+hypre+mumps+hdf5+metis~complex precision=double")
    depends_on("hdf5+mpi")
    depends_on("metis")
    depends_on("muparser")
    depends_on("nlohmann-json", type="build")

    def cmake_args(self):
        return [
            self.define("PULMO_ARCH", ""),  # the compiler's wrapper knows the target
            self.define("PULMO_TESTS", False),  # they need Debian's Python packages: tools/test
        ]
