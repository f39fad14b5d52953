// A lung with weight: the column under its own weight, gas that hangs in it, what bears it all; see README.md beside
// this file.
#include "unit/scenes.hpp"
#include "verification/support/column.hpp"

#include "pulmo/observers/energy.hpp"
#include "pulmo/observers/gravity_audit.hpp"

#include <complex>
#include <cstring>
#include <optional>

using namespace pulmo;
using namespace pulmo::test;

namespace {

using Complex = std::complex<double>;

/// W of a law in uniaxial strain, where I1 = J^2 + 2, I2 = 2 J^2 + 1, I3 = J^2: from the published formulas (Table 1 of
/// Aviles-Rojas & Hurtado 2022; c/beta in Birzle's), not from pulmo's.
std::optional<Complex> uniaxial_energy(const std::string &law, Complex J)
{
  const Complex I1 = J * J + 2.0, I2 = 2.0 * J * J + 1.0, I3 = J * J;
  if (law == "berger")
    return 0.2808 / 2 * (I1 - 3.0) + 0.4212 / 4 * (I3 - 1.0) - (0.2808 + 0.4212 / 2) * std::log(J - 1.0 + 0.99);
  if (law == "ma") {
    const Complex a = I1 / 2.0 - 1.5;
    return 2.0 * std::exp(0.43 * a * a - 0.6 * (I2 / 4.0 - I1 / 2.0 + 0.75));
  }
  if (law == "birzle") {
    const Complex shear = I1 * std::pow(I3, -1.0 / 3) - 3.0, bulk = std::pow(I3, 1.0 / 3) - 1.0;
    return 0.3567 * (I1 - 3.0) + 0.3567 / 1.075 * (std::pow(I3, -1.075) - 1.0) + 0.2782 * shear * shear * shear +
           5.766e-3 * bulk * bulk * bulk * bulk * bulk * bulk;
  }
  if (law == "yoshihara") return 1.298 * (I1 - 3.0) + 1.298 / 0.75 * (std::pow(I3, -0.75) - 1.0);
  if (law == "rausch") {
    const Complex shear = I1 * std::pow(I3, -1.0 / 3) - 3.0;
    return 4.1 * shear * shear + 20.7 * shear * shear * shear + 16.5 / 4 * (I3 - 1.0 - 2.0 * std::log(J));
  }
  if (law == "patte") // not of that table: tissue/patte.hpp
    return 0.2 * (I1 - 3.0 - 2.0 * std::log(J)) + 0.4 * (I2 - 3.0 - 4.0 * std::log(J)) +
           0.16 * (std::exp(0.5 * (I3 - 1.0 - 2.0 * std::log(J))) - 1.0);
  return {};
}

/// P(J) = W', by a complex step: no difference, no cancellation.
double uniaxial_stress(const std::string &law, double J)
{
  constexpr double h = 1e-30;
  return uniaxial_energy(law, {J, h}).value().imag() / h;
}

/// J with P(J) = stress, by bisection between J where the laws are stable.
double J_of_stress(const std::string &law, double stress)
{
  double low = 0.3, high = 1.7;
  for (int i = 0; i < 100; ++i) {
    const double J = (low + high) / 2;
    (uniaxial_stress(law, J) < stress ? low : high) = J;
  }
  return (low + high) / 2;
}

constexpr double kPa_per_mm = 1e-6; // weight of 1 kg/m^3 at 1 m/s^2

/// A column 0 <= X <= 1 mm that stands on X = 0 (g > 0) or hangs from it (g < 0): dP/dX = R g, P(1) = 0, with
/// R = solid + air (J - 1 + Phi0). Runge-Kutta of order 4 from the free end.
struct Column {
  static constexpr int n = 400;
  std::vector<double> J, u; ///< at X = i/n
  double base_stress = 0;

  Column(const std::string &law, double g, double solid, double air, double phi0) : J(n + 1), u(n + 1)
  {
    const auto slope = [&](double P, double &du) {
      const double at = J_of_stress(law, P);
      du = at - 1;
      return kPa_per_mm * g * (solid + air * (at - 1 + phi0));
    };
    double P = 0;
    const double h = -1.0 / n;
    for (int i = n;; --i) {
      J[i] = J_of_stress(law, P);
      if (i == 0) break;
      double du[4];
      const double a = slope(P, du[0]), b = slope(P + h / 2 * a, du[1]), c = slope(P + h / 2 * b, du[2]),
                   d = slope(P + h * c, du[3]);
      P += h / 6 * (a + 2 * b + 2 * c + d);
      u[i - 1] = u[i] + h / 6 * (du[0] + 2 * du[1] + 2 * du[2] + du[3]);
    }
    base_stress = P;
    const double shift = u[0];
    for (double &value : u) value -= shift;
  }
  static double at(const std::vector<double> &values, double X)
  {
    const double s = X * n;
    const int i = std::min(static_cast<int>(s), n - 1);
    return values[i] + (s - i) * (values[i + 1] - values[i]); // h^2/8 u'' = 1e-7
  }
};

/// Rollers on x0 and the sides of meshes/column.msh.
std::string column_options(const std::string &more)
{
  return "-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " +
         source("meshes/column.msh") +
         " -support -support_surfaces x0,sides_y,sides_z -support_components_x0 x -support_components_sides_y y"
         " -support_components_sides_z z -ts_dt 1 -ts_max_time 1 " +
         more;
}

double sum_of_ranks(double value)
{
  (void)MPI_Allreduce(MPI_IN_PLACE, &value, 1, MPI_DOUBLE, MPI_SUM, PETSC_COMM_WORLD);
  return value;
}
double most_of_ranks(double value)
{
  (void)MPI_Allreduce(MPI_IN_PLACE, &value, 1, MPI_DOUBLE, MPI_MAX, PETSC_COMM_WORLD);
  return value;
}

/// Keeps the last step's forces of supports, and its residual.
class Forces final : public Observer {
public:
  explicit Forces(const Model &model) : model_(model) {}
  PetscErrorCode observe(const StepReport &step) override
  {
    PetscFunctionBeginUser;
    if (step.row.dt > 0) PetscCall(model_.reactions(step.residual, list));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  std::array<double, 3> sum() const
  {
    std::array<double, 3> total{0, 0, 0};
    for (const auto &force : list)
      for (int d = 0; d < 3; ++d) total[d] += force[d];
    return total;
  }
  std::vector<std::array<PetscReal, 3>> list;

private:
  const Model &model_;
};

/// A run to its end.
struct Solved {
  pulmo::Run run{Registry::standard()};
  Sampling sampling;
  EnergyAudit energy{run.scene(), run.model(), sampling};
  Forces forces{run.model()};
  bool finished = false;

  PetscErrorCode go(const std::string &options)
  {
    PetscFunctionBeginUser;
    PetscCall(prepare(run, options));
    PetscCall(sampling.setup(run.model()));
    PetscCall(energy.setup());
    run.simulation().add(energy);
    run.simulation().add(forces);
    PetscCall(run.simulation().run(finished));
    if (!finished) PetscCall(PetscPrintf(PETSC_COMM_WORLD, "%s\n", run.simulation().failure_text().c_str()));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  Vec state() { return run.simulation().local_state(); }
  DM dm() { return run.model().dm(); }
};

/// Integral of u over the boundary facets in the plane x_d = value of a mesh of P2 displacement: the mean of the three
/// middles of edges, exact for it.
std::array<double, 3> integral_over_plane(DM dm, Vec local, int d, double value)
{
  static const std::vector<PetscReal> nodes{-1, -1, -1, 1, -1, -1, -1, 1,  -1, -1, -1, 1, 0,  -1, -1,
                                            -1, 0,  -1, 0, 0,  -1, -1, -1, 0,  0,  -1, 0, -1, 0,  0};
  static const int corners[4][3] = {{0, 1, 2}, {0, 1, 3}, {0, 2, 3}, {1, 2, 3}},
                   middles[4][3] = {{4, 5, 6}, {4, 7, 8}, {5, 7, 9}, {6, 8, 9}}; // 01 02 12 03 13 23
  std::array<double, 3> sum{0, 0, 0};
  std::vector<pulmo::test::Sample> cell;
  (void)sample_cells(dm, local, nodes, {}, [&](const pulmo::test::Sample &s) {
    cell.push_back(s);
    if (cell.size() < 10) return;
    for (int f = 0; f < 4; ++f) {
      const auto on = [&](int c) { return std::abs(cell[c].x[d] - value) < 1e-9; };
      if (!std::all_of(corners[f], corners[f] + 3, on)) continue;
      const PetscReal *a = cell[corners[f][0]].x, *b = cell[corners[f][1]].x, *c = cell[corners[f][2]].x;
      const int e = (d + 1) % 3, g = (d + 2) % 3;
      const double area = std::abs((b[e] - a[e]) * (c[g] - a[g]) - (b[g] - a[g]) * (c[e] - a[e])) / 2;
      for (int m : middles[f])
        for (int i = 0; i < 3; ++i) sum[i] += area / 3 * cell[m].u[i];
    }
    cell.clear();
  });
  for (double &s : sum) s = sum_of_ranks(s);
  return sum;
}

} // namespace

TEST(Gravity, ColumnUnderItsOwnWeightForEveryLaw)
{
  std::string without;
  for (const std::string &law : law_names()) {
    if (!uniaxial_energy(law, 1)) {
      without += " " + law;
      continue;
    }
    for (const double g : {900.0, -500.0}) { // stands, hangs
      // at the free end CM5 has no shear stiffness (its modulus at F = I is zero), and tension gives it none
      if (law == "rausch" && g < 0) continue;
      SCOPED_TRACE(law + (g > 0 ? " stands" : " hangs"));
      Solved s;
      PULMO_OK(s.go(column_options("-tissue " + law +
                                   " -gravity -gravity_tissue_density 1000 -gravity_air_density 100 "
                                   "-tissue_porosity 0.7 -gravity_direction " +
                                   (g > 0 ? "-2,0,0" : "0.5,0,0") + " -gravity_acceleration " +
                                   column::number(std::abs(g)))));
      ASSERT_TRUE(s.finished);
      const Column exact(law, g, 300, 100, 0.7);
      double u_error = 0, J_error = 0, u_size = 0;
      PULMO_OK(sample_corners(s.dm(), s.state(), [&](const pulmo::test::Sample &at) {
        const double u = Column::at(exact.u, at.x[0]);
        u_size = std::max(u_size, std::abs(u));
        u_error = std::max(u_error, std::abs(at.u[0] - u));
        J_error = std::max(J_error, std::abs(at.J() - Column::at(exact.J, at.x[0])));
      }));
      u_size = most_of_ranks(u_size);
      u_error = most_of_ranks(u_error);
      J_error = most_of_ranks(J_error);
      // the base bears the weight of all above it
      const double base = -s.forces.sum()[0] / 0.01;
      (void)PetscPrintf(PETSC_COMM_WORLD,
                        "  %-9s g %5.0f: J at the base %.4f  u(L) %9.6f  errors u %.1e J %.1e  base %.9f (%.9f) kPa\n",
                        law.c_str(), g, exact.J[0], exact.u[Column::n], u_error, J_error, base, exact.base_stress);
      EXPECT_GT(std::abs(exact.J[0] - J_of_stress(law, 0)), 0.005);
      EXPECT_LT(u_error, 2e-4 * u_size);
      EXPECT_LT(J_error, 5e-3 * std::abs(exact.J[0] - 1));
      EXPECT_NEAR(base, exact.base_stress, 1e-5 * std::abs(exact.base_stress));
    }
  }
  if (!without.empty()) GTEST_SKIP() << "uniaxial_energy has no published formula of" << without;
}

TEST(Gravity, GasAtRestIsHydrostaticAndTheTissueCarriesTheRest)
{
  // long enough that no flow is left; open at the top, where the pressure is that of the airway
  Solved s;
  PULMO_OK(s.go(column_options(
      "-tissue yoshihara -airflow -airflow_surfaces x1 -airflow_permeability 1 "
      "-gravity -gravity_tissue_density 1000 -gravity_air_density 200 -tissue_porosity 0.7 "
      "-gravity_direction -1,0,0 -gravity_acceleration 900 -ts_dt 1e3 -ts_max_time 4e3 -snes_atol 1e-9")));
  ASSERT_TRUE(s.finished);
  const Column exact("yoshihara", 900, 0.3 * (1000 - 200), 0, 0.7);
  const double top = 1 + exact.u[Column::n];
  double p_error = 0, u_error = 0, p_size = 0;
  PULMO_OK(sample_corners(s.dm(), s.state(), [&](const pulmo::test::Sample &at) {
    const double p = kPa_per_mm * 200 * 900 * (top - (at.x[0] + Column::at(exact.u, at.x[0])));
    p_size = std::max(p_size, p);
    p_error = std::max(p_error, std::abs(at.p - p));
    u_error = std::max(u_error, std::abs(at.u[0] - Column::at(exact.u, at.x[0])));
  }));
  p_error = most_of_ranks(p_error);
  p_size = most_of_ranks(p_size);
  u_error = most_of_ranks(u_error);
  (void)PetscPrintf(PETSC_COMM_WORLD, "  errors: p %.1e of %.4f kPa, u %.1e of %.5f mm; J at the base %.4f\n", p_error,
                    p_size, u_error, -exact.u[Column::n], exact.J[0]);
  EXPECT_LT(p_error, 1e-3 * p_size);
  EXPECT_LT(u_error, 1e-3 * std::abs(exact.u[Column::n]));
}

TEST(Gravity, TissueAsDenseAsTheGasFloatsInIt)
{
  // no weight is left for the tissue, so nothing moves, and the pressure is linear: both exact on any mesh
  Solved s;
  PULMO_OK(s.go("-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " +
                source("meshes/cube.msh") +
                " -mesh_scale 1 -tissue yoshihara -airflow -airflow_surfaces y1 -airflow_permeability 0.7 "
                "-lumen_pressure off -gravity "
                "-gravity_tissue_density 400 -gravity_air_density 400 -gravity_acceleration 500 "
                "-support -support_surfaces x0,x1,y0,y1,z0,z1 -support_components_x0 x -support_components_x1 x "
                "-support_components_y0 y -support_components_y1 y -support_components_z0 z -support_components_z1 z "
                "-ts_dt 1e6 -ts_max_time 1e6 -tissue_porosity 0.6"));
  ASSERT_TRUE(s.finished);
  double p_error = 0, u_size = 0, grad_error = 0;
  const double f = kPa_per_mm * 400 * 500;
  PULMO_OK(sample_corners(s.dm(), s.state(), [&](const pulmo::test::Sample &at) {
    p_error = std::max(p_error, std::abs(at.p - f * (1 - at.x[1])));
    for (int d = 0; d < 3; ++d) {
      u_size = std::max(u_size, std::abs(at.u[d]));
      grad_error = std::max(grad_error, std::abs(at.grad_p[d] + (d == 1 ? f : 0)));
    }
  }));
  EXPECT_LT(most_of_ranks(u_size), 1e-11);
  EXPECT_LT(most_of_ranks(p_error), 1e-11 * f);
  EXPECT_LT(most_of_ranks(grad_error), 1e-10 * f);
}

TEST(Gravity, SpringsAndSupportsBearTheWeight)
{
  for (const bool airflow : {false, true})
    for (const char *direction : {"full", "normal"}) {
      SCOPED_TRACE(std::string(direction) + (airflow ? " airflow" : ""));
      const double g = 700, K[2] = {0.9, 0.4}, tissue = 1100, air = 60, phi0 = 0.65;
      const double down[3] = {0.48, -0.64, 0.6};
      Solved s;
      PULMO_OK(s.go(
          "-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " +
          source("meshes/cube.msh") + " -mesh_scale 1 -tissue yoshihara -lumen_pressure off " +
          (airflow ? "-airflow -airflow_surfaces x1 -airflow_permeability 0.7 " : "") +
          "-chest_wall -chest_wall_surfaces x0,z1 -chest_wall_stiffness_x0 0.9 -chest_wall_stiffness_z1 0.4 "
          "-chest_wall_direction " +
          direction +
          " -support -support_surfaces y0 -gravity -gravity_tissue_density 1100 "
          "-gravity_air_density 60 -tissue_porosity 0.65 -gravity_direction 0.48,-0.64,0.6 -gravity_acceleration 700 "
          "-ts_dt 0.3 -ts_max_time 0.6"));
      ASSERT_TRUE(s.finished);
      const auto x0 = integral_over_plane(s.dm(), s.state(), 0, 0), z1 = integral_over_plane(s.dm(), s.state(), 2, 1);
      double volume_change = 0;
      PULMO_OK(sample_rule(s.dm(), s.state(), 6,
                           [&](const pulmo::test::Sample &at) { volume_change += at.weight * (at.J() - 1); }));
      volume_change = sum_of_ranks(volume_change);
      const bool full = std::strcmp(direction, "full") == 0;
      const auto supports = s.forces.sum();
      const double R = (1 - phi0) * tissue + (volume_change + phi0) * air;
      for (int d = 0; d < 3; ++d) {
        const double springs = (full || d == 0 ? K[0] * x0[d] : 0) + (full || d == 2 ? K[1] * z1[d] : 0);
        const double weight = kPa_per_mm * g * R * down[d];
        // a residual row is what a support takes from the lung
        EXPECT_NEAR(springs - supports[d], weight, 1e-9 * kPa_per_mm * g * R)
            << d << " " << springs << " " << supports[d];
      }
      EXPECT_LT(s.energy.rows().back().relative_residual(), 1e-9);
    }
}

TEST(Gravity, JacobianAgainstDifferencesWithAirflow)
{
  for (const bool airflow : {false, true}) {
    SceneSpec scene = full_scene(airflow);
    // so heavy that its terms are as large as the others
    scene.more = "-gravity -gravity_direction 0.3,-0.5,0.7 -gravity_acceleration 2000 -gravity_tissue_density 900 "
                 "-gravity_air_density 300 -tissue_porosity 0.6";
    SCOPED_TRACE(scene.text());
    SceneRun run(Registry::standard());
    State s;
    MatHandle A;
    VecHandle d, up, down, product;
    std::vector<PetscInt> fields, points;
    Random random(7);
    constexpr double h = 1e-4, shift = 2.3;
    PULMO_OK(prepare(run, scene.options()));
    PULMO_OK(random_state(run, 11, s));
    run.model().airway().hold(false);
    PULMO_OK(DMCreateMatrix(run.model().dm(), A.out()));
    PULMO_OK(run.model().jacobian(s.t, s.x, s.x_t, shift, A));
    PULMO_OK(DMCreateGlobalVector(run.model().dm(), d.out()));
    for (VecHandle *v : {&up, &down, &product}) PULMO_OK(VecDuplicate(d, v->out()));
    PULMO_OK(places_of_dofs(run, fields, points));
    for (int by = 0; by < (airflow ? 2 : 1); ++by)
      for (int trial = 0; trial < 6; ++trial) {
        {
          WriteArray entries(d);
          for (std::size_t i = 0; i < fields.size(); ++i) entries[i] = fields[i] == by ? random() * 0.1 : 0;
        }
        PULMO_OK(MatMult(A, d, product));
        std::vector<double> difference(fields.size(), 0);
        for (const double step : {h, h / 2}) { // Richardson: error h^4
          PULMO_OK(residual_at(run, s, d, step, shift, up));
          PULMO_OK(residual_at(run, s, d, -step, shift, down));
          const ReadArray a(up), b(down);
          for (std::size_t i = 0; i < fields.size(); ++i)
            difference[i] += (step == h ? -1. / 3 : 4. / 3) * (a[i] - b[i]) / (2 * step);
        }
        const ReadArray exact(product);
        for (int row = 0; row < (airflow ? 2 : 1); ++row) {
          double size = 0, error = 0;
          for (std::size_t i = 0; i < fields.size(); ++i)
            if (fields[i] == row) {
              size = std::max(size, std::abs(exact[i]));
              error = std::max(error, std::abs(exact[i] - difference[i]));
            }
          size = most_of_ranks(size); // a rank may have no row
          error = most_of_ranks(error);
          EXPECT_GT(size, 0);
          EXPECT_LT(error, 1e-8 * size) << "row " << row << " by " << by;
        }
      }
  }
}

TEST(Gravity, EnergyClosesWhileTheLungBreathes)
{
  // the work of the weight is a fair share of the whole, and the gas has weight, too
  for (const double dt : {0.1, 0.05}) {
    Solved s;
    PULMO_OK(s.go("-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " +
                  source("meshes/cube_lung.msh") +
                  " -mesh_scale 1 -ventilator pcv -ventilator_pip 8 -ventilator_inspiration 0.2 "
                  "-ventilator_expiration 0.2 -ventilator_ramp 0.1 -airflow -airflow_permeability 300 -chest_wall "
                  "-chest_wall_direction normal -chest_wall_surfaces pleura -gravity -gravity_direction 0.3,-0.5,0.7 "
                  "-gravity_acceleration 60 -gravity_air_density 100 -tissue_porosity 0.7 -ts_dt " +
                  column::number(dt)));
    ASSERT_TRUE(s.finished);
    const EnergyBalance &end = s.energy.rows().back();
    double external = 0, resistive = 0;
    for (std::size_t i = 0; i < s.energy.accounts().size(); ++i) {
      if (s.energy.accounts()[i].name == "external") external = end.accounts[i];
      if (s.energy.accounts()[i].name == "resistive") resistive = end.accounts[i];
    }
    (void)PetscPrintf(PETSC_COMM_WORLD,
                      "  dt %g: ventilator %.3e J, external %.3e J, resistive %.3e J, residual %.1e of it\n", dt,
                      end.ventilator_work, external, resistive, end.relative_residual());
    EXPECT_GT(std::abs(external), 1e-2 * std::abs(end.ventilator_work));
    EXPECT_GT(resistive, 0);
    EXPECT_LT(end.relative_residual(), 1e-9);
    // the work of a steady weight on one column: see SpringsAndSupportsBearTheWeight; here it comes to rest first
    EXPECT_EQ(s.run.scene().facts().ventilator->phases().front().name, "settle");
  }
}

TEST(Gravity, OffIsAsIfItWereNotThere)
{
  const std::string scene =
      "-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " +
      source("meshes/cube_lung.msh") +
      " -mesh_scale 1 -ventilator pcv -ventilator_pip 8 -ventilator_inspiration 0.1 -ventilator_expiration 0.1 "
      "-airflow -airflow_permeability 300 -chest_wall ";
  Solved without, off;
  PULMO_OK(without.go(scene));
  PULMO_OK(off.go(scene + "-gravity_direction 1,0,0 -gravity_tissue_density 3000 -gravity off"));
  const ReadArray a(without.state()), b(off.state());
  PetscInt n;
  PULMO_OK(VecGetLocalSize(without.state(), &n));
  PetscMPIInt ranks;
  PULMO_OK(MPI_Comm_size(PETSC_COMM_WORLD, &ranks));
  if (ranks == 1) { // several may share the mesh in another way
    EXPECT_EQ(std::memcmp(a.data(), b.data(), sizeof(PetscScalar) * static_cast<std::size_t>(n)), 0);
  }
  EXPECT_NEAR(off.run.simulation().rows().back().volume / without.run.simulation().rows().back().volume, 1, 1e-10);
  EXPECT_FALSE(off.run.scene().facts().gravity);
  for (const ParameterBlock &block : off.run.model().composition().parameter_blocks())
    EXPECT_TRUE(std::strcmp(block.owner, "gravity") != 0 && std::strcmp(block.owner, "gas_force") != 0);
  for (const Term &term : off.run.model().composition().terms()) EXPECT_NE(term.effect, "gravity");
}

TEST(Gravity, PorosityAndDensityOfARegionChangeItsWeight)
{
  // both lungs, not run: the weight is what the residual of the undeformed lung sums to, and what the summary says
  pulmo::Run run(Registry::standard());
  const double phi[2] = {0.8, 0.6}, rho[2] = {1000, 1100}, air = 1.5, g = 9.80665;
  PULMO_OK(prepare(
      run, "-dm_plex_filename " + source("meshes/lung_pair.msh") +
               " -pc_type lu -elements P1-P1 -tissue yoshihara -chest_wall -chest_wall_surfaces pleura -gravity "
               "-gravity_direction 0,0,-3 -tissue_porosity 0.8,left_lung=0.6 "
               "-gravity_tissue_density 1000,left_lung=1100 -gravity_air_density 1.5"));
  std::vector<Mesh::Region> regions;
  Sampling sampling;
  PULMO_OK(run.scene().mesh().regions(regions));
  PULMO_OK(sampling.setup(run.model()));
  double grams = 0;
  for (const Mesh::Region &region : regions) {
    double volume = 0;
    for (const PetscInt c : region.cells) {
      PetscReal one;
      PetscInt first;
      PULMO_OK(DMPlexGetHeightStratum(run.model().dm(), 0, &first, nullptr));
      PULMO_OK(DMPlexComputeCellGeometryFVM(run.model().dm(), first + c, &one, nullptr, nullptr));
      volume += one;
    }
    const int left = region.name == "left_lung";
    ASSERT_TRUE(left || region.name == "right_lung");
    grams += 1e-6 * sum_of_ranks(volume) * ((1 - phi[left]) * rho[left] + phi[left] * air);
  }
  EXPECT_GT(grams, 500);
  VecHandle x, x_t, local, global;
  Model::ResidualSums sums;
  PULMO_OK(DMCreateLocalVector(run.model().dm(), x.out()));
  PULMO_OK(VecDuplicate(x, x_t.out()));
  PULMO_OK(VecDuplicate(x, local.out()));
  PULMO_OK(DMCreateGlobalVector(run.model().dm(), global.out()));
  PULMO_OK(VecZeroEntries(x));
  PULMO_OK(VecZeroEntries(x_t));
  PULMO_OK(run.model().set_step(1, 0));
  PULMO_OK(run.model().residual(0, x, x_t, local));
  PULMO_OK(VecZeroEntries(global));
  PULMO_OK(DMLocalToGlobal(run.model().dm(), local, ADD_VALUES, global));
  PULMO_OK(run.model().residual_sums(global, sums));
  // 1 kPa mm^2 = 1e-3 N; yoshihara's tissue is free of stress at rest, only z has a load
  EXPECT_NEAR(sums.net[displacement] * 1e-3, grams * 1e-3 * g, 1e-10 * grams * 1e-3 * g);
  GravityAudit audit(run.scene(), run.model(), sampling);
  PULMO_OK(audit.setup());
  EXPECT_NEAR(audit.weight(), grams, 1e-10 * grams);
}

TEST(Gravity, GradientAndThirdsOfAStretchThatIsKnown)
{
  // a column that hangs: J of its own law over height, integrated here
  Solved s;
  PULMO_OK(set_options(""));
  GravityAudit audit(s.run.scene(), s.run.model(), s.sampling);
  PULMO_OK(
      prepare(s.run, column_options("-tissue yoshihara -gravity -gravity_tissue_density 1000 -gravity_air_density 0 "
                                    "-tissue_porosity 0.7 -gravity_direction 1,0,0 -gravity_acceleration 500")));
  PULMO_OK(s.sampling.setup(s.run.model()));
  PULMO_OK(audit.setup());
  s.run.simulation().add(audit);
  PULMO_OK(s.run.simulation().run(s.finished));
  ASSERT_TRUE(s.finished);
  const Column exact("yoshihara", -500, 300, 0, 0.7);
  double mean[3], slope = 0;    // height is 1 - X: it hangs from X = 0, the highest place
  for (int t = 0; t < 3; ++t) { // thirds from the lowest, X = 1
    const double from = 1 - (t + 1) / 3., to = 1 - t / 3.;
    mean[t] = 1 + 3 * (Column::at(exact.u, to) - Column::at(exact.u, from));
  }
  for (int i = 0; i < Column::n; ++i) {
    const double X = (i + 0.5) / Column::n;
    slope += (Column::at(exact.J, X) - 1) * (0.5 - X) / Column::n * 12; // variance of the height: 1/12
  }
  (void)PetscPrintf(PETSC_COMM_WORLD, "  J of thirds %.5f %.5f %.5f, slope %.5f per mm\n", mean[0], mean[1], mean[2],
                    slope);
  EXPECT_GT(slope, 0); // what lies high is stretched
  EXPECT_NEAR(audit.gradient(1) / 10, slope, 2e-3 * slope);
  // cells lie across the cuts, points do not: thirds of a coarse column are near, and exact together
  double all = 0, volume = 0;
  for (int t = 0; t < 3; ++t) {
    EXPECT_NEAR(audit.mean_J(1, t), mean[t], 0.05 * (mean[2] - mean[0]));
    all += audit.volume(t) * (audit.mean_J(1, t) - 1);
    volume += audit.volume(t);
  }
  EXPECT_NEAR(volume, 1e-5, 1e-15);
  EXPECT_NEAR(all / volume, exact.u[Column::n], 1e-4 * exact.u[Column::n]);
  EXPECT_NEAR(audit.weight(), 300 * 0.01 * 1e-6, 1e-15);
}

TEST(Gravity, AnAirwayHeldAtOnePressureLetsLittleGasCirculate)
{
  // one pressure over an opening that has height is not hydrostatic: gas goes in below and out above
  Solved s;
  PULMO_OK(s.go("-options_file " + source("petsc_options/solvers/tight.opts") + " -dm_plex_filename " +
                source("meshes/lung_test.msh") +
                " -tissue birzle -airflow -airflow_permeability 1e4 -chest_wall -chest_wall_surfaces pleura "
                "-chest_wall_direction normal -ts_dt 20 -ts_max_time 60 -snes_atol 1e-9 -options_file " +
                source("petsc_options/scenes/supine.opts")));
  ASSERT_TRUE(s.finished);
  const DM dm = s.dm();
  VecHandle still, local, global, marks, at_airway;
  PetscSection section;
  std::vector<PetscInt> facets;
  PULMO_OK(DMCreateLocalVector(dm, local.out()));
  PULMO_OK(VecDuplicate(local, still.out()));
  PULMO_OK(VecDuplicate(local, marks.out()));
  PULMO_OK(DMCreateGlobalVector(dm, global.out()));
  PULMO_OK(VecDuplicate(global, at_airway.out()));
  PULMO_OK(VecZeroEntries(still));
  PULMO_OK(VecZeroEntries(marks));
  PULMO_OK(VecZeroEntries(global));
  PULMO_OK(VecZeroEntries(at_airway));
  PULMO_OK(s.run.model().residual(60, s.state(), still, local));
  PULMO_OK(DMLocalToGlobal(dm, local, ADD_VALUES, global));
  PULMO_OK(DMGetLocalSection(dm, &section));
  PULMO_OK(s.run.scene().mesh().facets("airway", facets));
  {
    WriteArray mark(marks);
    for (const PetscInt facet : facets) {
      PetscInt *closure = nullptr, n;
      PULMO_OK(DMPlexGetTransitiveClosure(dm, facet, PETSC_TRUE, &n, &closure));
      for (PetscInt i = 0; i < n; ++i) {
        PetscInt dof, offset;
        PULMO_OK(PetscSectionGetFieldDof(section, closure[2 * i], pressure, &dof));
        PULMO_OK(PetscSectionGetFieldOffset(section, closure[2 * i], pressure, &offset));
        if (dof > 0) mark[offset] = 1;
      }
      PULMO_OK(DMPlexRestoreTransitiveClosure(dm, facet, PETSC_TRUE, &n, &closure));
    }
  }
  PULMO_OK(DMLocalToGlobal(dm, marks, ADD_VALUES, at_airway));
  double in = 0, out = 0;
  {
    const ReadArray flux(global), mark(at_airway);
    PetscInt n;
    PULMO_OK(VecGetLocalSize(global, &n));
    for (PetscInt i = 0; i < n; ++i)
      if (mark[i] > 0) (flux[i] > 0 ? in : out) += flux[i] / s.run.model().row_scale(pressure) / 1000; // ml/s
  }
  in = sum_of_ranks(in);
  out = sum_of_ranks(out);
  // what the force on the gas alone would drive through the opening
  const double most = 1e4 * kPa_per_mm * 1.2 * 9.80665 * s.run.scene().mesh().surface("airway").area / 1000;
  (void)PetscPrintf(PETSC_COMM_WORLD, "  %.3g ml/s in and %.3g out; at most %.3g\n", in, out, most);
  EXPECT_GT(in, 0);
  EXPECT_NEAR(in + out, 0, 1e-3 * in);
  EXPECT_LT(in, most);
}
