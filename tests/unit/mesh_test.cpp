// The mesh of a scene: every flavour of MSH that is read, two bodies, refinement, scaling, pins.
#include "support/scene.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>

namespace pulmo::test {
namespace {

/// Reads one mesh as a scene does.
PetscErrorCode read(Mesh &mesh, const std::string &file, const std::string &more = "")
{
  Options options(PETSC_COMM_WORLD);

  PetscFunctionBeginUser;
  PetscCall(set_options("-dm_plex_filename " + source("meshes/" + file) + " " + more));
  PetscCall(mesh.declare(options));
  PetscCall(mesh.read(options, false));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Pins against all six motions of each body.
PetscErrorCode pins_of_all(const Mesh &mesh, std::vector<Mesh::Pin> &pins)
{
  std::vector<Mesh::Body> bodies;

  PetscFunctionBeginUser;
  PetscCall(mesh.bodies(bodies));
  for (const Mesh::Body &body : bodies) {
    std::vector<Mesh::Pin> more;
    PetscCall(mesh.rigid_pins(body, more));
    pins.insert(pins.end(), more.begin(), more.end());
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

class Flavour : public ::testing::TestWithParam<const char *> {};

TEST_P(Flavour, IsTheSameCube)
{
  Mesh mesh;
  PULMO_OK(read(mesh, GetParam()));
  EXPECT_EQ(mesh.cells(), 24);
  EXPECT_NEAR(mesh.volume(), 1, 1e-12);
  ASSERT_EQ(mesh.surfaces().size(), 2u);
  EXPECT_NEAR(mesh.surface("airway").area, 1, 1e-12);
  EXPECT_NEAR(mesh.surface("pleura").area, 5, 1e-12);
}

INSTANTIATE_TEST_SUITE_P(Msh, Flavour,
                         ::testing::Values("cube_msh22_ascii.msh", "cube_msh22_binary.msh", "cube_msh41_ascii.msh",
                                           "cube_msh41_binary.msh"));

TEST(Mesh, RefinementKeepsVolumeAndSurfaces)
{
  Mesh mesh;
  PULMO_OK(read(mesh, "cube_msh41_binary.msh", "-dm_refine 1"));
  EXPECT_EQ(mesh.cells(), 8 * 24);
  EXPECT_NEAR(mesh.volume(), 1, 1e-12);
  EXPECT_NEAR(mesh.surface("airway").area, 1, 1e-12);
  EXPECT_NEAR(mesh.surface("pleura").area, 5, 1e-12);
}

TEST(Mesh, ScaleMultipliesTheCoordinates)
{
  Mesh mesh;
  PULMO_OK(read(mesh, "cube_msh22_ascii.msh", "-mesh_scale 1000"));
  EXPECT_NEAR(mesh.volume(), 1e9, 1);
  EXPECT_NEAR(mesh.surface("pleura").area, 5e6, 1e-3);
  EXPECT_NEAR(mesh.length(), 1000 / std::cbrt(24.), 1e-6);
}

TEST(Mesh, TwoLungsAreOneMesh)
{
  Mesh mesh;
  PULMO_OK(read(mesh, "lung_pair.msh"));
  EXPECT_EQ(mesh.cells(), 11645);
  EXPECT_NEAR(mesh.volume(), 2600e3, 1); // exact by tools/lung_mesh's scaling
  EXPECT_EQ(mesh.surfaces().size(), 2u);
}

TEST(Mesh, PinsFollowAxes)
{
  Mesh mesh;
  std::vector<Mesh::Pin> pins;
  PULMO_OK(read(mesh, "cube.msh"));
  PULMO_OK(pins_of_all(mesh, pins));
  ASSERT_EQ(pins.size(), 3u);
  // the cube has corners along its axes: none of the pins turns it when it swells about the first
  for (int k = 1; k < 3; ++k)
    for (int d = 0; d < 3; ++d) {
      if (pins[k].component[d]) {
        EXPECT_NEAR(pins[k].x[d], pins[0].x[d], 1e-12) << "pin " << k << " component " << d;
      }
    }
  int held = 0;
  for (const Mesh::Pin &pin : pins)
    for (bool component : pin.component) held += component;
  EXPECT_EQ(held, 6);
}

TEST(Mesh, EachLungHasItsOwnPins)
{
  Mesh mesh;
  std::vector<Mesh::Pin> pins;
  PULMO_OK(read(mesh, "lung_pair.msh"));
  PULMO_OK(pins_of_all(mesh, pins));
  ASSERT_EQ(pins.size(), 6u);
  for (int body = 0; body < 2; ++body) // the right lung lies at x > 0, the left one at x < 0
    for (int k = 1; k < 3; ++k) EXPECT_GT(pins[3 * body + k].x[0] * pins[3 * body].x[0], 0);
  EXPECT_LT(pins[0].x[0] * pins[3].x[0], 0);
}

/// Largest difference between the numbers of two cells of this rank that share a face.
PetscErrorCode bandwidth(DM dm, PetscInt &largest)
{
  PetscInt begin, end;

  PetscFunctionBeginUser;
  largest = 0;
  PetscCall(DMPlexGetHeightStratum(dm, 1, &begin, &end));
  for (PetscInt face = begin; face < end; ++face) {
    PetscInt n;
    const PetscInt *cells;
    PetscCall(DMPlexGetSupportSize(dm, face, &n));
    PetscCall(DMPlexGetSupport(dm, face, &cells));
    if (n == 2) largest = std::max(largest, std::abs(cells[0] - cells[1]));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

// On several ranks, too.
TEST(Renumbering, BringsNeighboursTogether)
{
  Mesh mesh;
  DMHandle file;
  std::array<PetscInt, 2> widths;
  PULMO_OK(read(mesh, "lung_pair.msh"));
  PULMO_OK(
      DMPlexCreateFromFile(PETSC_COMM_WORLD, source("meshes/lung_pair.msh").c_str(), "file", PETSC_TRUE, file.out()));
  PULMO_OK(bandwidth(mesh.dm(), widths[0]));
  PULMO_OK(bandwidth(file, widths[1]));
  PULMO_OK(MPI_Allreduce(MPI_IN_PLACE, widths.data(), 2, MPIU_INT, MPI_MAX, PETSC_COMM_WORLD));
  EXPECT_LT(widths[0], widths[1] / 4);
}

TEST(Renumbering, SharedPointsStayThoseOfTheirOwners)
{
  Mesh mesh;
  PetscSF sf;
  PetscInt end, roots, n_leaves;
  const PetscInt *leaves;
  PULMO_OK(read(mesh, "lung_pair.msh"));
  PULMO_OK(DMPlexGetChart(mesh.dm(), nullptr, &end));
  PULMO_OK(DMGetPointSF(mesh.dm(), &sf));
  PULMO_OK(PetscSFGetGraph(sf, &roots, &n_leaves, &leaves, nullptr));
  if (roots < 0) return; // one rank
  std::vector<PetscReal> x(static_cast<std::size_t>(3 * end), 0);
  for (PetscInt depth = 0; depth < 2; ++depth) {
    PetscInt first, last;
    PULMO_OK(DMPlexGetDepthStratum(mesh.dm(), depth, &first, &last));
    for (PetscInt p = first; p < last; ++p) PULMO_OK(mesh.node_coordinates(p, &x[3 * p]));
  }
  for (int d = 0; d < 3; ++d) {
    std::vector<PetscReal> mine(static_cast<std::size_t>(end)), theirs(mine);
    for (PetscInt p = 0; p < end; ++p) mine[p] = x[3 * p + d];
    PULMO_OK(PetscSFBcastBegin(sf, MPIU_REAL, mine.data(), theirs.data(), MPI_REPLACE));
    PULMO_OK(PetscSFBcastEnd(sf, MPIU_REAL, mine.data(), theirs.data(), MPI_REPLACE));
    for (PetscInt i = 0; i < n_leaves; ++i) EXPECT_EQ(mine[leaves ? leaves[i] : i], theirs[leaves ? leaves[i] : i]);
  }
}

} // namespace
} // namespace pulmo::test
