// What holds a lung: the rigid motions that are left free, pins against just these, values prescribed twice.
#include "pulmo/fem/pins.hpp"
#include "support/scene.hpp"
#include "unit/scenes.hpp"

#include <cmath>

namespace pulmo::test {
namespace {

const std::string block = "-dm_plex_filename " + source("meshes/cube_coarse.msh") + " -mesh_scale 100 -pc_type lu ";
const std::string all = "x0,x1,y0,y1,z0,z1";
const std::string roller = "-support -support_surfaces z0 -support_components_z0 z ";
const std::string rollers =
    "-support -support_surfaces x0,y0,z0 -support_components_x0 x -support_components_y0 y -support_components_z0 z ";

/// How the bodies of a scene are held, before any pins.
PetscErrorCode look(const std::string &options, std::vector<HeldBody> &held)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);

  PetscFunctionBeginUser;
  PetscCall(prepare(run, options));
  PetscCall(find_held(run.model().composition(), held));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Part of a motion that lies in the span of orthonormal ones, squared; 1 for the whole of a unit motion.
double share_in(const std::vector<RigidMotion> &span, const RigidMotion &motion)
{
  double share = 0;
  for (const RigidMotion &one : span) {
    double product = 0;
    for (int a = 0; a < 6; ++a) product += one[a] * motion[a];
    share += product * product;
  }
  return share;
}

TEST(Held, ARollerLeavesThreeMotionsFree)
{
  std::vector<HeldBody> held;
  PULMO_OK(look(block + roller, held));
  ASSERT_EQ(held.size(), 1u);
  EXPECT_NEAR(held[0].size, 50 * std::sqrt(3.), 1e-9);
  ASSERT_EQ(held[0].free.size(), 3u);
  for (const int a : {0, 1, 5}) {
    RigidMotion motion{};
    motion[a] = 1;
    EXPECT_NEAR(share_in(held[0].free, motion), 1, 1e-12) << a;
  }
  EXPECT_EQ(describe(held[0], held[0].free), "translation along x, translation along y, rotation about the axis along "
                                             "z through (50, 50, 50) mm");
}

TEST(Held, ThreeRollersHoldEverything)
{
  std::vector<HeldBody> held;
  PULMO_OK(look(block + rollers, held));
  EXPECT_TRUE(held[0].free.empty());
  EXPECT_EQ(held[0].weakest_stiffness, 0); // springs have nothing to hold
}

TEST(Held, TwoRollersLeaveATranslation)
{
  std::vector<HeldBody> held;
  PULMO_OK(look(block + "-support -support_surfaces x0,z0 -support_components_x0 x -support_components_z0 z", held));
  EXPECT_EQ(describe(held[0], held[0].free), "translation along y");
}

TEST(Held, ComponentsOfOneFaceLeaveATurnAboutIt)
{
  std::vector<HeldBody> held;
  PULMO_OK(look(block + "-support -support_surfaces z0 -support_components_z0 xy", held));
  EXPECT_EQ(
      describe(held[0], held[0].free),
      "translation along z, rotation about the axis along x through (50, 50, 0) mm, rotation about the axis along "
      "y through (50, 50, 0) mm");
}

TEST(Held, NormalSpringsOnABox)
{
  const double K = 0.3, side = 100;
  std::vector<HeldBody> held;
  PULMO_OK(look(
      block + "-chest_wall -chest_wall_direction normal -chest_wall_stiffness 0.3 -chest_wall_surfaces " + all, held));
  EXPECT_TRUE(held[0].free.empty());
  // translations: K times two faces; rotations: K int y^2 over four faces, on a lever of R = side sqrt(3) / 2
  EXPECT_NEAR(held[0].largest_stiffness / (2 * K * side * side), 1, 1e-12);
  EXPECT_NEAR(held[0].weakest_stiffness / (4. / 9 * K * side * side), 1, 1e-12);
}

TEST(Held, FullSpringsOnOneFace)
{
  std::vector<HeldBody> held;
  PULMO_OK(look(block + "-chest_wall -chest_wall_stiffness 0.3 -chest_wall_surfaces z0", held));
  EXPECT_TRUE(held[0].free.empty());
  PULMO_OK(look(block + "-chest_wall -chest_wall_direction normal -chest_wall_surfaces z0", held));
  EXPECT_EQ(held[0].free.size(), 3u);
}

TEST(Held, WeakSpringsHoldAsStrongOnesDo)
{
  std::vector<HeldBody> held;
  PULMO_OK(look(block + "-chest_wall -chest_wall_stiffness 1e-12 -chest_wall_surfaces z0 " + roller, held));
  EXPECT_TRUE(held[0].free.empty());
  PULMO_OK(look(block + "-chest_wall -chest_wall_stiffness 0 -chest_wall_surfaces z0 " + roller, held));
  EXPECT_EQ(held[0].free.size(), 3u);
}

/// Springs that resist u . N or u . n hold the turns of a sphere by its facets alone: as the square of their size.
TEST(Held, NormalSpringsHardlyHoldTheTurnsOfASphere)
{
  for (const std::string direction : {"normal", "current_normal"}) {
    std::vector<HeldBody> held;
    PULMO_OK(look("-dm_plex_filename " + source("meshes/hollow_sphere.msh") +
                      " -mesh_scale 1 -pc_type lu -chest_wall -chest_wall_direction " + direction +
                      " -chest_wall_surfaces pleura -chest_wall_stiffening 1 -chest_wall_offset 5",
                  held));
    EXPECT_TRUE(held[0].free.empty());
    EXPECT_LT(held[0].weakest_stiffness / held[0].largest_stiffness, 0.025);
    double turn = 0;
    for (int a = 3; a < 6; ++a) turn += held[0].weakest[a] * held[0].weakest[a];
    EXPECT_GT(turn, 0.99);
  }
}

/// A hold of an effect that pulmo does not know: springs in the volume that resist motion along x and y.
void foundation(PetscInt, PetscInt, PetscInt, const PetscInt[], const PetscInt[], const PetscScalar[],
                const PetscScalar[], const PetscScalar[], const PetscInt[], const PetscInt[], const PetscScalar[],
                const PetscScalar[], const PetscScalar[], PetscReal, PetscReal, const PetscReal[], PetscInt,
                const PetscScalar[], PetscScalar g0[])
{
  g0[0] += 2;
  g0[4] += 2;
}

class Foreign : public ::testing::Test {
protected:
  void SetUp() override
  {
    Options options(PETSC_COMM_WORLD);
    PULMO_OK(set_options(block));
    PULMO_OK(mesh_.declare(options));
    PULMO_OK(mesh_.read(options, false));
  }
  Mesh mesh_;
  Elements elements_;
};

TEST_F(Foreign, TermsAndConstraintsTakePart)
{
  Composition composition(mesh_, elements_);
  std::vector<HeldBody> held;
  composition.field("displacement", 3, 2, "mm");
  composition.jacobian("foundation", displacement, displacement, g0(Callback<PetscPointJac>{foundation}));
  PULMO_OK(find_held(composition, held));
  EXPECT_EQ(describe(held[0], held[0].free), "translation along z");
  // K int r^2 dx over the cube, on the lever R^2 = 3/4 side^2; the turn about x meets the foundation in y alone
  EXPECT_NEAR(held[0].weakest_stiffness / (2 * 1e6 * (1. / 12) / 0.75), 1, 1e-12);

  Constraint pole; // holds z on one face
  pole.name = "pole";
  pole.surface = "x1";
  pole.component[2] = true;
  pole.value = [](PetscReal, const PetscReal[3], PetscScalar u[3]) { u[0] = u[1] = u[2] = 0; };
  composition.constrain(pole);
  PULMO_OK(find_held(composition, held));
  EXPECT_TRUE(held[0].free.empty());
}

/// The components that a pinned scene holds beside its supports, as rows of displacements by the free motions.
TEST_F(Foreign, PinsAreAsManyAsFreeMotionsAndHoldThem)
{
  const std::vector<std::vector<std::pair<std::string, std::string>>> scenes{
      {{"z0", "z"}}, {{"z0", "xy"}}, {{"z0", "z"}, {"x0", "x"}}, {{"x1", "y"}}, {{"x0", "xyz"}}, {}};
  for (const auto &scene : scenes) {
    Composition composition(mesh_, elements_);
    std::vector<HeldBody> before, after;
    composition.field("displacement", 3, 2, "mm");
    for (const auto &[surface, components] : scene) {
      Constraint hold;
      hold.surface = surface;
      for (int d = 0; d < 3; ++d) hold.component[d] = components.find("xyz"[d]) != std::string::npos;
      hold.value = [](PetscReal, const PetscReal[3], PetscScalar u[3]) { u[0] = u[1] = u[2] = 1; };
      composition.constrain(hold);
    }
    PULMO_OK(find_held(composition, before));
    composition.speaker("someone");
    composition.pin_free_motions();
    PULMO_OK(pin_free_motions(composition));
    PULMO_OK(find_held(composition, after));
    EXPECT_TRUE(after[0].free.empty());
    std::size_t pinned = 0;
    for (const Constraint &c : composition.constraints()) {
      if (c.pinned_body < 0) continue;
      EXPECT_EQ(c.effect, "someone");
      for (int d = 0; d < 3; ++d) {
        pinned += c.component[d];
        for (const PetscInt vertex : c.vertices) { // not what something else holds
          PetscReal x[3];
          PULMO_OK(mesh_.node_coordinates(vertex, x));
          for (const auto &[surface, components] : scene)
            if (c.component[d] && components.find("xyz"[d]) != std::string::npos) {
              const PetscReal face = surface[1] == '1' ? 100 : 0;
              EXPECT_GT(std::abs(x[surface[0] - 'x'] - face), 1e-6) << surface << " "
                                                                    << "xyz"[d];
            }
        }
      }
    }
    EXPECT_EQ(pinned, before[0].free.size());
  }
}

} // namespace
} // namespace pulmo::test
