// What the effects that a scene does not ask for cost: the scene of the options database by a program that has them
// all, and by one that has only those that are on, in turns in one process. Called by tools/benchmark effects.
//
//   pulmo_off_benchmark -dm_plex_filename ... -options_file ... [-benchmark_repeats N]
//
// Prints one JSON object: what each program made and did, CPU seconds of the fastest of its runs, and whether their
// states and signals are the same bit for bit.
#include "pulmo/fem/point_memory.hpp"
#include "pulmo/pulmo.hpp"

#include <algorithm>
#include <cstring>
#include <ctime>
#include <memory>
#include <set>
#include <sstream>

#ifdef __GLIBC__
#include <malloc.h>
#endif

namespace {

using namespace pulmo;

double cpu_seconds()
{
  timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/// Bytes that are in use.
long long heap()
{
#if defined(__GLIBC__) && (__GLIBC__ > 2 || (__GLIBC__ == 2 && __GLIBC_MINOR__ >= 33))
  const auto info = mallinfo2();
  return static_cast<long long>(info.uordblks + info.hblkhd);
#else
  return 0;
#endif
}

/// What a run was made of, what it did, and where it ended.
struct Found {
  std::size_t effects = 0, fields = 0, terms = 0, constraints = 0, constants = 0, scalars = 0, columns = 0;
  PetscInt dofs = 0, remembered = 0;
  double nonzeros = 0;
  long newton = 0, krylov = 0, steps = 0;
  std::vector<PetscReal> numbers; ///< of all signals and of the last state
  double seconds = 0;
  long long heap = 0; ///< bytes that the run holds at its end

  std::string counts() const
  {
    std::ostringstream s;
    s.precision(15);
    s << "\"fields\": " << fields << ", \"terms\": " << terms << ", \"constraints\": " << constraints
      << ", \"kernel constants\": " << constants << ", \"scalar unknowns\": " << scalars
      << ", \"columns of signals\": " << columns << ", \"unknowns\": " << dofs << ", \"matrix nonzeros\": " << nonzeros
      << ", \"scalars remembered at a point\": " << remembered << ", \"steps\": " << steps
      << ", \"Newton iterations\": " << newton << ", \"Krylov iterations\": " << krylov;
    return s.str();
  }
};

PetscErrorCode breathe(const Registry &registry, Found &found)
{
  bool finished;
  MatHandle matrix;
  MatInfo info;

  PetscFunctionBeginUser;
  const long long before = heap();
  Run run(registry);
  const double start = cpu_seconds();
  PetscCall(run.declare());
  PetscCall(run.setup());
  PetscCall(run.simulation().run(finished));
  found.seconds = cpu_seconds() - start;
  found.heap = heap() - before;
  PetscCheck(finished, PETSC_COMM_WORLD, PETSC_ERR_NOT_CONVERGED, "the run did not finish: %s",
             run.simulation().failure_text().c_str());
  const Composition &c = run.model().composition();
  found.effects = run.scene().effects().size();
  found.fields = c.fields().size();
  found.terms = c.terms().size() + c.energies().size();
  found.constraints = c.constraints().size();
  found.constants = c.constants(Step()).size();
  found.scalars = c.n_scalars();
  found.columns = c.signals().size();
  found.remembered = c.memory_width();
  PetscCall(VecGetSize(run.simulation().state(), &found.dofs));
  PetscCall(run.model().create_matrix(matrix.out()));
  PetscCall(MatGetInfo(matrix, MAT_GLOBAL_SUM, &info));
  found.nonzeros = info.nz_allocated;
  found.numbers.clear();
  found.newton = found.krylov = 0;
  for (const SignalRow &row : run.simulation().rows()) {
    found.newton += row.newton;
    found.krylov += row.krylov;
    for (const double v : {row.time, row.pressure, row.flow, row.volume, row.min_J, row.max_J})
      found.numbers.push_back(v);
  }
  found.steps = static_cast<long>(run.simulation().rows().size()) - 1;
  PetscInt n;
  const PetscScalar *x;
  PetscCall(VecGetLocalSize(run.simulation().state(), &n));
  PetscCall(VecGetArrayRead(run.simulation().state(), &x));
  found.numbers.insert(found.numbers.end(), x, x + n);
  PetscCall(VecRestoreArrayRead(run.simulation().state(), &x));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// pulmo's registry without the effects that the scene leaves off.
PetscErrorCode only_active(Registry &registry)
{
  std::set<std::string> active;

  PetscFunctionBeginUser;
  Run run(Registry::standard());
  PetscCall(run.declare());
  PetscCall(run.setup());
  for (const Effect *effect : run.scene().active()) active.insert(effect->name());
  registry = Registry::standard().without([&](const Effect &e) { return active.count(e.name()) == 0; });
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode benchmark()
{
  PetscInt repeats = 5;
  Registry lean;
  Found all, few;
  double slow[2] = {0, 0}, fast[2] = {PETSC_MAX_REAL, PETSC_MAX_REAL};
  bool same = true;

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetInt(nullptr, nullptr, "-benchmark_repeats", &repeats, nullptr));
  PetscCall(only_active(lean));
  for (PetscInt i = 0; i < repeats; ++i) {
    if (i % 2) PetscCall(breathe(lean, few)); // neither is always the first
    PetscCall(breathe(Registry::standard(), all));
    if (i % 2 == 0) PetscCall(breathe(lean, few));
    same = same && all.counts() == few.counts() && all.numbers.size() == few.numbers.size() &&
           std::memcmp(all.numbers.data(), few.numbers.data(), all.numbers.size() * sizeof(PetscReal)) == 0;
    const double now[2] = {all.seconds, few.seconds};
    for (int k = 0; k < 2; ++k) {
      slow[k] = std::max(slow[k], now[k]);
      fast[k] = std::min(fast[k], now[k]);
    }
  }
  PetscCall(
      PetscPrintf(PETSC_COMM_WORLD,
                  "{\"all\": {\"effects\": %d, %s, \"heap\": %lld, \"seconds\": %.6f, \"slowest\": %.6f}, \"few\": "
                  "{\"effects\": %d, %s, \"heap\": %lld, \"seconds\": %.6f, \"slowest\": %.6f}, \"same\": %s, "
                  "\"repeats\": %d}\n",
                  (int)all.effects, all.counts().c_str(), all.heap, fast[0], slow[0], (int)few.effects,
                  few.counts().c_str(), few.heap, fast[1], slow[1], same ? "true" : "false", (int)repeats));
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
