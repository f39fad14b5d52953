// Times residual and Jacobian of the scene of the options database, with pulmo's integrator and with PETSc's own
// (`-petscfe_type basic`) in the same run, and compares what they give. Called by tools/benchmark.
//
//   pulmo_assembly_benchmark -dm_plex_filename ... -options_file ... [-benchmark_repeats N] [-benchmark_stock on|off]
//
// Prints one JSON object: seconds are CPU time of rank 0, medians over the repeats.
#include "pulmo/pulmo.hpp"

#include <algorithm>
#include <cmath>
#include <ctime>
#include <functional>

namespace {

using namespace pulmo;

double cpu_seconds()
{
  timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/// Medians over the repeats; the works take turns as they do in Newton's method, so that none finds its data in the
/// cache.
PetscErrorCode median_seconds(PetscInt repeats, const std::vector<std::function<PetscErrorCode()>> &works,
                              std::vector<double> &seconds)
{
  std::vector<std::vector<double>> all(works.size());

  PetscFunctionBeginUser;
  for (PetscInt i = 0; i <= repeats; ++i)
    for (std::size_t w = 0; w < works.size(); ++w) {
      const double start = cpu_seconds();
      PetscCall(works[w]());
      if (i > 0) all[w].push_back(cpu_seconds() - start); // the first call also finds positions in the matrix
    }
  seconds.clear();
  for (std::vector<double> &one : all) {
    std::nth_element(one.begin(), one.begin() + repeats / 2, one.end());
    seconds.push_back(one[static_cast<std::size_t>(repeats / 2)]);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A smooth admissible state: stretch, shear and a wave of a tenth of the strain; J between about 1.1 and 1.6.
PetscErrorCode smooth_state(Run &run, Vec local, Vec rate)
{
  const DM dm = run.model().dm();
  const PetscReal k = 6.28 / std::cbrt(run.scene().mesh().volume());
  PetscSection section;
  PetscInt begin, end, n_fields;

  PetscFunctionBeginUser;
  WriteArray u(local), u_t(rate);
  PetscCall(DMGetLocalSection(dm, &section));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  PetscCall(DMGetNumFields(dm, &n_fields));
  std::vector<std::array<PetscReal, 3>> nodes;
  for (PetscInt p = begin; p < end; ++p) {
    PetscInt dof, offset;
    PetscCall(PetscSectionGetFieldDof(section, p, displacement, &dof));
    PetscCall(PetscSectionGetFieldOffset(section, p, displacement, &offset));
    PetscCall(node_coordinates(dm, p, dof / 3, nodes));
    for (const auto &x : nodes) {
      for (int d = 0; d < 3; ++d, ++offset) {
        u[offset] = 0.1 * x[d] + 0.03 * x[(d + 1) % 3] + 0.05 / k * std::sin(k * x[(d + 2) % 3]);
        u_t[offset] = 0.3 * u[offset];
      }
    }
    if (n_fields <= pressure) continue;
    PetscCall(PetscSectionGetFieldDof(section, p, pressure, &dof));
    PetscCall(PetscSectionGetFieldOffset(section, p, pressure, &offset));
    PetscCall(node_coordinates(dm, p, dof, nodes));
    for (const auto &x : nodes) u[offset++] = 0.4 + 0.1 * std::cos(k * x[0]);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

struct Result {
  double residual = 0, jacobian = 0; // s
  MatHandle matrix;
  VecHandle vector;
};

PetscErrorCode measure(const char *type, PetscInt repeats, Result &result, PetscInt &cells)
{
  VecHandle local, rate;
  const double dt = 0.05;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsSetValue(nullptr, "-petscfe_type", type));
  Run run(Registry::standard());
  PetscCall(run.declare());
  PetscCall(run.setup());
  Model &model = run.model();
  cells = run.scene().mesh().cells();
  PetscCall(DMCreateLocalVector(model.dm(), local.out()));
  PetscCall(VecDuplicate(local, rate.out()));
  PetscCall(VecDuplicate(local, result.vector.out()));
  PetscCall(smooth_state(run, local, rate));
  PetscCall(model.set_step(dt, 0.3));
  PetscCall(model.create_matrix(result.matrix.out()));
  std::vector<double> seconds;
  PetscCall(median_seconds(repeats,
                           {[&] { return model.residual(dt, local, rate, result.vector); },
                            [&] { return model.jacobian(dt, local, rate, 1 / dt, result.matrix); }},
                           seconds));
  result.residual = seconds[0];
  result.jacobian = seconds[1];
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode benchmark()
{
  PetscInt repeats = 7, cells = 0;
  PetscBool stock = PETSC_TRUE;
  Result own, basic;
  PetscReal vector_norm = 1, vector_difference = 0, matrix_norm = 1, matrix_difference = 0;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetInt(nullptr, nullptr, "-benchmark_repeats", &repeats, nullptr));
  PetscCall(PetscOptionsGetBool(nullptr, nullptr, "-benchmark_stock", &stock, nullptr));
  PetscCall(measure("pulmo", repeats, own, cells));
  if (stock) {
    PetscCall(measure("basic", 1, basic, cells));
    PetscCall(VecNorm(basic.vector, NORM_2, &vector_norm));
    PetscCall(VecAXPY(own.vector, -1, basic.vector));
    PetscCall(VecNorm(own.vector, NORM_2, &vector_difference));
    PetscCall(MatNorm(basic.matrix, NORM_FROBENIUS, &matrix_norm));
    PetscCall(MatAXPY(own.matrix, -1, basic.matrix, SAME_NONZERO_PATTERN));
    PetscCall(MatNorm(own.matrix, NORM_FROBENIUS, &matrix_difference));
  }
  const double us = 1e6 / (double)cells;
  PetscCall(PetscPrintf(PETSC_COMM_WORLD,
                        "{\"cells\": %d, \"residual_us\": %.4f, \"jacobian_us\": %.4f, \"stock_residual_us\": %.4f, "
                        "\"stock_jacobian_us\": %.4f, \"residual_difference\": %.3e, \"jacobian_difference\": %.3e}\n",
                        (int)cells, us * own.residual, us * own.jacobian, us * basic.residual, us * basic.jacobian,
                        (double)(vector_difference / vector_norm), (double)(matrix_difference / matrix_norm)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

int main(int argc, char **argv)
{
  if (PetscInitialize(&argc, &argv, nullptr, nullptr) != 0) return 1;
  int code = pulmo::initialize();
  if (code == 0) code = benchmark();
  if (PetscFinalize() != 0) code = 1;
  return code == 0 ? 0 : 1;
}
