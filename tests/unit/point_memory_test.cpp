// What effects remember at the points of cells and facets: closed forms, where it is, both integrators, other ranks.
#include "registered.hpp"
#include "unit/scenes.hpp"
#include "verification/support/integrators.hpp"
#include "verification/support/scene_parts.hpp"

#include "pulmo/fem/point_memory.hpp"

#include <filesystem>
#include <fstream>

namespace pulmo::test {
namespace {

const std::string cube = "-dm_plex_filename " + source("meshes/cube_coarse.msh") + " -mesh_scale 1 -pc_type lu ";

constexpr double stiffness = 0.4, yield = 0.3; // kPa/mm, s
const std::string tether = "-tether -tether_surfaces x1,y0 -tether_stiffness 0.4 -tether_time 0.3 ";

/// The cube moves as a whole along x: nothing but the tethers of two faces (mm^2 each) bears a force.
Registry carried(const std::function<double(double)> &way)
{
  Registry r = registry_of_the_page();
  for (const char *face : {"x0", "x1", "y0", "y1", "z0", "z1"})
    add_essential(r, displacement, face, [way](PetscReal t, const PetscReal[3], PetscScalar v[3]) {
      v[0] = way(t);
      v[1] = v[2] = 0;
    });
  return r;
}

/// Force of all constraints along x after each step, and what the memory says then.
class Force final : public Observer {
public:
  explicit Force(SceneRun &run) : run_(run) {}
  PetscErrorCode observe(const StepReport &step) override
  {
    std::vector<std::array<PetscReal, 3>> forces;

    PetscFunctionBeginUser;
    if (step.row.time == 0) PetscFunctionReturn(PETSC_SUCCESS);
    PetscCall(run_.model().reactions(step.residual, forces));
    values.push_back(0);
    for (const auto &f : forces) values.back() += f[0];
    const auto &memories = run_.model().composition().memories();
    for (const MemorySpec &spec : memories) {
      std::vector<PetscScalar> means;
      run_.model().memory()->means(spec, 0, means);
      for (const PetscScalar mean : means)
        if (!std::isnan(mean)) {
          EXPECT_NEAR(mean, values.back() / 2, 1e-10) << spec.surface;
          ++facets;
        }
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  std::vector<double> values;
  int facets = 0;

private:
  SceneRun &run_;
};

void carry(const std::function<double(double)> &way, const std::string &options, std::vector<double> &forces)
{
  const Registry registry = carried(way);
  SceneRun run(registry);
  bool finished = false;
  PULMO_OK(prepare(run, cube + tether + "-airflow off -tissue yoshihara -ventilator_settle off -snes_atol 1e-13 " +
                            "-snes_rtol 1e-12 " + options));
  Force force(run);
  run.simulation().add(force);
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished) << run.simulation().failure_text();
  forces = force.values;
  MPI_Allreduce(MPI_IN_PLACE, &force.facets, 1, MPI_INT, MPI_SUM, PETSC_COMM_WORLD);
  // both faces have four triangles, of cells of their own
  EXPECT_EQ(force.facets, static_cast<int>(forces.size()) * 8);
}

TEST(PointMemory, SpringsYieldAsBackwardEulerMust)
{
  constexpr double dt = 0.05, speed = 2;
  std::vector<double> forces;
  ASSERT_NO_FATAL_FAILURE(carry([](double t) { return speed * t; }, "-ts_max_time 0.5 -ts_dt 0.05", forces));
  ASSERT_EQ(forces.size(), 10u);
  double h = 0;
  for (const double force : forces) {
    h = (h + stiffness * speed * dt) / (1 + dt / yield);
    EXPECT_NEAR(force, 2 * h, 1e-10);
  }
}

TEST(PointMemory, OrderInTime)
{
  constexpr double t_end = 0.6;
  const auto way = [](double t) { return 0.1 * std::sin(M_PI * t) * std::sin(M_PI * t); };
  // h = int stiffness exp(-(t - s) / yield) dw by parts, Simpson's rule
  constexpr int n = 2000;
  double integral = 0;
  for (int i = 0; i <= n; ++i)
    integral += (i == 0 || i == n ? 1
                 : i % 2          ? 4
                                  : 2) *
                way(t_end * i / n) * std::exp(-(t_end - t_end * i / n) / yield);
  const double expected = 2 * stiffness * (way(t_end) - integral * t_end / n / 3 / yield);
  for (const Integrator &integrator : integrators) {
    double error[3];
    for (int i = 0; i < 3; ++i) {
      std::vector<double> forces;
      ASSERT_NO_FATAL_FAILURE(
          carry(way, "-ts_max_time 0.6 -ts_dt " + std::to_string(t_end / (12 << i)) + integrator.options, forces));
      ASSERT_EQ(forces.size(), static_cast<std::size_t>(12 << i));
      error[i] = forces.back() - expected;
    }
    EXPECT_NEAR(std::log2(error[1] / error[2]), integrator.order, 0.15 * integrator.order) << integrator.name;
    EXPECT_LT(std::abs(error[2]), 0.05 * std::abs(expected));
  }
}

/// Remembers where it is, in the cells or on surfaces; its kernels push where the memory is of another point.
template <int Which>
struct Where {
  static constexpr int values = 1 + Which; ///< x first; effects that remember more or less move each other's place
  struct Parameters {
    static constexpr const char *owner = Which == 0 ? "test_where_0" : "test_where_1";
    PetscScalar factor = 1;
  };
  static PetscScalar mark(const Point &point)
  {
    return point.x[0] + 10 * point.x[1] + 100 * point.x[2] + (point.normal ? 1000 : 0) + 1e4 * Which;
  }
  static void remember(const Point &point, const Parameters &k, PetscScalar value[])
  {
    for (int i = 0; i < values; ++i) value[i] = k.factor * mark(point);
  }
  static void push(const Point &point, const Parameters &k, PetscScalar f0[])
  {
    for (int i = 0; i < values; ++i)
      f0[0] += point.memory.last ? std::abs(point.memory.last[i] - k.factor * mark(point)) : 1e3;
  }
};

template <int Which>
class WhereEffect final : public TestEffect {
public:
  explicit WhereEffect(std::vector<std::string> surfaces, bool twice = false)
      : surfaces_(std::move(surfaces)), twice_(twice)
  {}
  const char *name() const override { return Which == 0 ? "test_where_0" : "test_where_1"; }
  const char *about() const override { return "remembers where it is"; }
  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    using K = Where<Which>;
    using P = typename K::Parameters;
    const std::vector<Quantity> quantities(K::values, {"where", "mm"});
    c.parameters(parameters_);
    if (Which == 0 || twice_) {
      c.remember(quantities, remembered<P, K::remember>);
      c.residual("where", displacement, f0(volume_residual<P, K::push>));
    }
    if (twice_) c.remember(quantities, remembered<P, K::remember>);
    for (const std::string &surface : surfaces_) {
      c.remember(quantities, remembered<P, K::remember>, surface);
      c.surface_residual("where", surface, displacement, f0(surface_residual<P, K::push>));
    }
    return PETSC_SUCCESS;
  }

private:
  std::vector<std::string> surfaces_;
  bool twice_;
  typename Where<Which>::Parameters parameters_;
};

/// Size of the residual of the lung at rest.
void residual_at_rest(const Registry &registry, const std::string &options, PetscReal &size)
{
  SceneRun run(registry);
  VecHandle x, x_t, F;
  PULMO_OK(prepare(run, cube + "-airflow off -tissue yoshihara -chest_wall -chest_wall_surfaces x0 " + options));
  PULMO_OK(DMCreateLocalVector(run.model().dm(), x.out()));
  for (VecHandle *v : {&x_t, &F}) PULMO_OK(VecDuplicate(x, v->out()));
  PULMO_OK(run.model().set_step(0.1, 0));
  PULMO_OK(run.model().residual(0.1, x, x_t, F));
  PULMO_OK(VecNorm(F, NORM_MAX, &size));
}

TEST(PointMemory, EveryPointHasItsOwn)
{
  for (const std::string options : {"", "-petscfe_type basic ", "-elements P3-P2 "}) {
    SCOPED_TRACE(options);
    Registry registry = Registry::standard();
    registry.effect([] { return std::make_unique<WhereEffect<0>>(std::vector<std::string>{"x1", "y0"}); });
    registry.effect([] { return std::make_unique<WhereEffect<1>>(std::vector<std::string>{"y0", "z1"}); });
    PetscReal size = 1;
    ASSERT_NO_FATAL_FAILURE(residual_at_rest(registry, options, size));
    EXPECT_LT(size, 1e-9); // of 1e4
  }
}

TEST(PointMemory, HasOneMeaning)
{
  Registry registry = Registry::standard();
  registry.effect([] { return std::make_unique<WhereEffect<0>>(std::vector<std::string>{"x1"}, true); });
  SceneRun run(registry);
  PULMO_OK(set_options(cube + "-airflow off -chest_wall -chest_wall_surfaces x0"));
  PULMO_OK(run.declare());
  PULMO_OK(PetscPushErrorHandler(PetscIgnoreErrorHandler, nullptr));
  const PetscErrorCode code = run.setup();
  PULMO_OK(PetscPopErrorHandler());
  EXPECT_EQ(static_cast<int>(code), PETSC_ERR_ARG_WRONGSTATE);
}

void volumes(const std::string &options, std::vector<double> &list)
{
  const Registry registry = registry_of_the_page();
  SceneRun run(registry);
  bool finished = false;
  PULMO_OK(
      prepare(run, cube + tether +
                       "-ventilator pcv -ventilator_pip 4 -ventilator_inspiration 0.2 -ventilator_expiration 0.2 "
                       "-airflow -airflow_permeability 3 -airflow_surfaces x1 -lumen_pressure off -chest_wall "
                       "-chest_wall_surfaces x0,y1,z0 -viscoelastic -tissue yoshihara -ts_dt 0.05 -ts_max_time 0.3 "
                       "-snes_rtol 1e-12 -snes_atol 1e-12 " +
                       options));
  PULMO_OK(run.simulation().run(finished));
  ASSERT_TRUE(finished) << run.simulation().failure_text();
  for (const SignalRow &row : run.simulation().rows()) list.push_back(row.volume);
}

TEST(PointMemory, BothIntegratorsRemember)
{
  std::vector<double> own, basic, forgetful;
  ASSERT_NO_FATAL_FAILURE(volumes("", own));
  ASSERT_NO_FATAL_FAILURE(volumes("-petscfe_type basic", basic));
  ASSERT_NO_FATAL_FAILURE(volumes("-tether_time 1e-9 -viscoelastic_moduli 0,0,0", forgetful));
  ASSERT_EQ(own.size(), basic.size());
  double largest = 0, matters = 0;
  for (std::size_t i = 0; i < own.size(); ++i) {
    largest = std::max(largest, std::abs(own[i]));
    matters = std::max(matters, std::abs(own[i] - forgetful[i]));
  }
  EXPECT_GT(matters, 0.05 * largest);
  for (std::size_t i = 0; i < own.size(); ++i) EXPECT_NEAR(own[i], basic[i], 1e-9 * largest);
}

/// The last line of a file.
std::string last_line(const std::string &path)
{
  std::ifstream file(path);
  std::string line, last;
  while (std::getline(file, line))
    if (!line.empty()) last = line;
  return last;
}

TEST(PointMemory, GoesOnOnOtherRanks)
{
  const char *folder = std::getenv("PULMO_MEMORY_CHECKPOINT");
  if (!folder) GTEST_SKIP() << "PULMO_MEMORY_CHECKPOINT names a folder that runs on one rank leave";
  const std::string scene =
      "-dm_plex_filename " + source("meshes/cube_lung.msh") +
      " -mesh_scale 1 -pc_type lu -pc_factor_mat_solver_type mumps -ventilator pcv -ventilator_pip 4 "
      "-ventilator_inspiration 0.2 "
      "-ventilator_expiration 0.2 -airflow -airflow_permeability 300 -chest_wall -tissue yoshihara -ts_dt 0.05 "
      "-ventilator_settle off -tether -tether_surfaces pleura,airway -tether_time 0.2 -viscoelastic -snes_rtol 1e-12 "
      "-progress off -output_overwrite ";
  PetscMPIInt size;
  const Registry registry = registry_of_the_page();
  bool finished = false;
  PULMO_OK(MPI_Comm_size(PETSC_COMM_WORLD, &size));
  const std::string here = std::string(folder) + "/";
  if (size == 1) {
    PULMO_OK(set_options(scene + "-ts_max_time 0.4 -output_dir " + here + "whole"));
    PULMO_OK(pulmo::run(registry, finished));
    ASSERT_TRUE(finished);
    PULMO_OK(set_options(scene + "-ts_max_time 0.2 -checkpoint_every 0.1 -output_dir " + here + "half"));
    PULMO_OK(pulmo::run(registry, finished));
    ASSERT_TRUE(finished);
  }
  const std::string rest = here + "rest_" + std::to_string(size);
  PULMO_OK(set_options(scene + "-ts_max_time 0.4 -restart " + here + "half/checkpoint.h5 -output_dir " + rest));
  PULMO_OK(pulmo::run(registry, finished));
  ASSERT_TRUE(finished);
  std::istringstream whole(last_line(here + "whole/signals.csv")), other(last_line(rest + "/signals.csv"));
  std::string a, b;
  for (int column = 0; column < 4; ++column) { // time, pressure, flow, volume
    std::getline(whole, a, ',');
    std::getline(other, b, ',');
    EXPECT_NEAR(std::stod(b), std::stod(a), 1e-8 * (1 + std::abs(std::stod(a)))) << column;
  }
}

} // namespace
} // namespace pulmo::test
