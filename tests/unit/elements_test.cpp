// Element pairs: where their nodes lie, and what is written of them.
#include "pulmo/base/units.hpp"
#include "pulmo/observers/output.hpp"
#include "unit/scenes.hpp"
#include "verification/support/fields.hpp"

namespace pulmo::test {
namespace {

/// A polynomial that elements of @p degree hold, and those of a lower degree do not.
double polynomial(PetscInt degree, const double x[3], double seed)
{
  double sum = 0, power = 1;
  for (PetscInt k = 0; k <= degree; ++k, power *= x[0] + 0.7 * x[1] - 0.4 * x[2] + seed) sum += power;
  return degree < 3 ? sum : sum + x[0] * x[1] * x[2];
}

class ElementPairs : public ::testing::TestWithParam<const char *> {
protected:
  void SetUp() override
  {
    SceneSpec scene;
    scene.airflow = true;
    scene.chest_wall = "full";
    scene.more = std::string("-elements ") + GetParam();
    PULMO_OK(set_options(scene.options() + " -output_dir " + directory_ + " -output_overwrite"));
    PULMO_OK(run_.declare());
    PULMO_OK(output_.declare(run_.options()));
    PULMO_OK(run_.setup());
    PULMO_OK(DMCreateLocalVector(run_.model().dm(), local_.out()));
    degrees_ = run_.scene().facts().elements;
    PULMO_OK(interpolate(
        run_, local_, [this](const double x[3]) { return u(x); }, [this](const double x[3]) { return p(x); }));
  }
  std::array<double, 3> u(const double x[3]) const
  {
    const PetscInt k = degrees_.displacement_degree;
    return {polynomial(k, x, 0.1), polynomial(k, x, -0.3), polynomial(k, x, 0.6)};
  }
  double p(const double x[3]) const { return polynomial(degrees_.pressure_degree, x, 0.2); }

  const std::string directory_ = ::testing::TempDir() + "pulmo_elements";
  SceneRun run_{Registry::standard()};
  Output output_;
  VecHandle local_;
  Elements degrees_;
};

// The polynomial's nodal values at our nodes make the polynomial, by PETSc's tabulation and closures.
TEST_P(ElementPairs, NodesLieWhereTheBasisHasThem)
{
  double error = 0, size = 0;
  PULMO_OK(sample_rule(run_.model().dm(), local_, 4, [&](const Sample &s) {
    const auto expected = u(s.x);
    for (int i = 0; i < 3; ++i) {
      error = std::max(error, std::abs(s.u[i] - expected[i]));
      size = std::max(size, std::abs(expected[i]));
    }
    error = std::max(error, std::abs(s.p - p(s.x)));
  }));
  EXPECT_GT(size, 1);
  EXPECT_LT(error, 1e-13 * size);
}

// The quadratic cells of the files have the values of u and p at their ten nodes, whatever the elements.
TEST_P(ElementPairs, FieldsAtVerticesAndMiddles)
{
  PULMO_OK(output_.prepare(run_.options(), "", {}));
  FieldWriter writer(output_, run_.scene(), run_.model());
  PULMO_OK(writer.snapshot(0, local_));
  const auto load = [&](const char *file, const char *name, VecHandle &v) -> PetscErrorCode {
    Handle<PetscViewer, PetscViewerDestroy> viewer;
    PetscFunctionBeginUser;
    PetscCall(PetscViewerCreate(PETSC_COMM_SELF, viewer.out()));
    PetscCall(PetscViewerSetType(viewer, PETSCVIEWERHDF5));
    PetscCall(PetscViewerFileSetMode(viewer, FILE_MODE_READ));
    PetscCall(PetscViewerFileSetName(viewer, (directory_ + "/" + file).c_str()));
    PetscCall(VecCreate(PETSC_COMM_SELF, v.out()));
    PetscCall(PetscObjectSetName((PetscObject)(Vec)v, name));
    PetscCall(VecLoad(v, viewer));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  VecHandle geometry, displacements, pressures;
  PetscInt n;
  PULMO_OK(load("fields.h5", "geometry", geometry));
  PULMO_OK(load("fields_00000.h5", "displacement_mm", displacements));
  PULMO_OK(load("fields_00000.h5", "alveolar_pressure_cmH2O", pressures));
  PULMO_OK(VecGetSize(pressures, &n));
  EXPECT_GT(n, 14) << "more nodes than vertices";
  const ReadArray x(geometry), us(displacements), ps(pressures);
  for (PetscInt i = 0; i < n; ++i) {
    const double *at = x.data() + 3 * i;
    for (int d = 0; d < 3; ++d) EXPECT_NEAR(us[3 * i + d], u(at)[d], 1e-12);
    EXPECT_NEAR(ps[i] * units::kPa_per_cmH2O, p(at), 1e-12);
  }
}

INSTANTIATE_TEST_SUITE_P(, ElementPairs, ::testing::Values("P2-P1", "P1-P1", "P3-P2"),
                         [](const auto &pair) { return std::string(pair.param, 2) + std::string(pair.param + 3); });

} // namespace
} // namespace pulmo::test
