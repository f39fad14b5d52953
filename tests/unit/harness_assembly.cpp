// Checks of what effects assemble: Jacobians, what one that is off leaves, both integrators.
#include "unit/harness.hpp"

#include "pulmo/fem/point_memory.hpp"

#include <algorithm>
#include <cmath>

namespace pulmo::test {

namespace {

/// Stages of backward Euler and of BDF2.
std::vector<Stage> stages(PetscReal dt)
{
  return {Stage(dt), Stage(dt, 1.5 / dt, true, -2 / dt, 0.5 / dt)};
}

/// Residual and Jacobian of a random state with a free airway, of the rows of this rank, and what there is to them.
struct Assembled {
  std::vector<double> residual, values;
  std::vector<PetscInt> pattern; ///< of each row: how many columns, and which
  std::map<std::string, double> counts;
};

PetscErrorCode rows_of(Mat A, Assembled &a)
{
  PetscInt begin, end;

  PetscFunctionBeginUser;
  PetscCall(MatGetOwnershipRange(A, &begin, &end));
  for (PetscInt row = begin; row < end; ++row) {
    PetscInt width;
    const PetscInt *columns;
    const PetscScalar *values;
    PetscCall(MatGetRow(A, row, &width, &columns, &values));
    a.pattern.push_back(width);
    a.pattern.insert(a.pattern.end(), columns, columns + width);
    a.values.insert(a.values.end(), values, values + width);
    PetscCall(MatRestoreRow(A, row, &width, &columns, &values));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode assemble(SceneRun &run, Assembled &a)
{
  State s;
  VecHandle F;
  MatHandle A;
  PetscInt n;

  PetscFunctionBeginUser;
  run.model().airway().hold(false);
  PetscCall(random_state(run, 77, s));
  PetscCall(DMCreateGlobalVector(run.model().dm(), F.out()));
  PetscCall(run.model().create_matrix(A.out()));
  const IntegrationLog before = run.model().assembly().log();
  PetscCall(residual_at(run, s, nullptr, 0, 1 / s.dt, F));
  PetscCall(run.model().jacobian(s.t, s.x, s.x_t, 1 / s.dt, A));
  const IntegrationLog &log = run.model().assembly().log();
  PetscCall(VecGetLocalSize(F, &n));
  const ReadArray f(F);
  a.residual.assign(f.data(), f.data() + n);
  PetscCall(rows_of(A, a));
  const Composition &c = run.model().composition();
  a.counts = {{"callbacks of a residual", log.residual_calls - before.residual_calls},
              {"callbacks of a Jacobian", log.jacobian_calls - before.jacobian_calls},
              {"fields", c.fields().size()},
              {"terms", c.terms().size()},
              {"constraints", c.constraints().size()},
              {"terms of the energy", c.energies().size()},
              {"blocks of parameters", c.parameter_blocks().size()},
              {"bytes of memory", run.model().memory() ? run.model().memory()->bytes() : 0}};
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode assemble(const Registry &registry, const std::string &options, Assembled &a)
{
  SceneRun run(registry);

  PetscFunctionBeginUser;
  PetscCall(build(run, options));
  PetscCall(assemble(run, a));
  PetscFunctionReturn(PETSC_SUCCESS);
}

bool same(const Assembled &a, const Assembled &b)
{
  return a.pattern == b.pattern && a.residual == b.residual && a.values == b.values;
}

/// The largest difference over the largest number.
double difference(const std::vector<double> &a, const std::vector<double> &b)
{
  double largest = 0, apart = 0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    largest = std::max({largest, std::abs(a[i]), std::abs(b[i])});
    apart = std::max(apart, std::abs(a[i] - b[i]));
  }
  return apart > 0 ? apart / largest : 0;
}

/// The rows of a held airway say x - value: closed as Newton sees them.
PetscErrorCode closed_residual(SceneRun &run, State &s, Vec d, PetscReal h, PetscReal shift, Vec F)
{
  VecHandle X;

  PetscFunctionBeginUser;
  PetscCall(residual_at(run, s, d, h, shift, F));
  PetscCall(VecDuplicate(F, X.out()));
  PetscCall(DMLocalToGlobal(run.model().dm(), s.work, INSERT_VALUES, X));
  PetscCall(run.model().airway().close_rows(X, F));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode check_jacobian(const Subject &subject, Findings &findings)
{
  constexpr PetscReal tolerated = 1e-7;
  SceneRun run(subject.registry);
  State s;
  VecHandle d;
  PetscReal difference, size;

  PetscFunctionBeginUser;
  PetscCall(build(run, subject.options()));
  run.model().airway().hold(subject.airway == Airway::held);
  PetscCall(random_state(run, static_cast<unsigned>(90 + subject.text().size()), s));
  PetscCall(random_direction(run, d));
  if (subject.airway == Airway::held) PetscCall(run.model().airway().set(d, 0)); // Newton never moves these
  for (const Stage &stage : stages(s.dt)) {
    const auto residual = [&](PetscReal h, Vec F) { return closed_residual(run, s, d, h, stage.slope, F); };
    PetscCall(compare_jacobian(run, s, stage, d, residual, difference, size));
    if (!(size > 0 && difference < tolerated * size))
      findings.push_back(std::string("the Jacobian under ") + (stage.multistep ? "BDF2" : "backward Euler") +
                         " differs from that by differences by " + shown(difference / size));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

namespace {

/// What differs in the files of a step; @p effects: what summary.json lists beside.
void compare_files(const Outcome &with, const Outcome &without, Findings &findings)
{
  for (const Outcome *o : {&with, &without})
    if (!o->told() || o->code != 0) {
      findings.push_back("a step of the scene without it ends with " + o->said.errors);
      return;
    }
  for (const char *file : {"signals.csv", "energy.csv", "fields.xdmf"}) {
    const std::string &a = with.files.at(file), &b = without.files.at(file);
    const auto header = [](const std::string &text) { return text.substr(0, text.find('\n')); };
    if (header(a) != header(b))
      findings.push_back(std::string("columns of ") + file + " while it is off: " + header(a) + " instead of " +
                         header(b));
    else if (a != b)
      findings.push_back(std::string("numbers in ") + file + " differ while it is off");
  }
  const auto listed = [](const std::string &json) {
    const std::size_t begin = json.find("\"effects\"");
    return json.substr(begin, json.find(']', begin) - begin);
  };
  if (listed(with.files.at("summary.json")) != listed(without.files.at("summary.json")))
    findings.push_back("summary.json lists it while it is off");
}

} // namespace

/// A scene in which it is off against one that has never heard of it.
PetscErrorCode check_off(const Subject &subject, Findings &findings)
{
  const std::string &name = subject.effects.front();
  const Registry rest = subject.registry.without([&](const Effect &e) { return e.name() == name; });
  Subject unheard = subject;
  Assembled without, off, on;

  PetscFunctionBeginUser;
  unheard.registry = rest;
  const std::string scene = unheard.surroundings(), turned_off = scene + "-" + name + " off ";
  PetscCall(assemble(rest, scene, without));
  PetscCall(assemble(subject.registry, turned_off, off));
  PetscCall(assemble(subject.registry, subject.options(), on));
  if (off.pattern != without.pattern)
    findings.push_back("the pattern differs while it is off");
  else if (off.residual != without.residual || off.values != without.values)
    findings.push_back("numbers differ while it is off");
  for (const auto &[what, count] : off.counts)
    if (count != without.counts.at(what))
      findings.push_back(what + " while it is off: " + shown(count) + " instead of " + shown(without.counts.at(what)));
  const Folder folder;
  const std::string one_step = "-ts_max_time 0.05 ";
  const Outcome a = run_program(subject.registry, turned_off + one_step, folder.path("off")),
                b = run_program(rest, scene + one_step, folder.path("unheard"));
  compare_files(a, b, findings);
  // what is on does something
  if (!same(on, without)) PetscFunctionReturn(PETSC_SUCCESS);
  const Outcome acting = run_program(subject.registry, subject.options() + one_step, folder.path("on"));
  if (acting.code == 0 && b.code == 0 && acting.table("signals.csv") == b.table("signals.csv"))
    findings.push_back("it changes nothing while it is on");
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// pulmo's integrator against PETSc's.
PetscErrorCode check_integrators(const Subject &subject, Findings &findings)
{
  constexpr double rounding = 1e-12;
  SceneRun run(subject.registry);
  Assembled own, basic;

  PetscFunctionBeginUser;
  PetscCall(build(run, subject.options()));
  PetscCall(assemble(run, own));
  SceneRun other(subject.registry);
  Quiet::Said said;
  const PetscErrorCode code = build(other, subject.options() + "-petscfe_type basic", &said);
  if (code == PETSC_ERR_USER_INPUT && one_sentence(said.errors)) PetscFunctionReturn(PETSC_SUCCESS); // needs pulmo's
  PetscCall(code);
  PetscCall(assemble(other, basic));
  if (own.pattern != basic.pattern)
    findings.push_back("the pattern differs with -petscfe_type basic");
  else if (const double f = difference(own.residual, basic.residual); !(f < rounding))
    findings.push_back("the residual differs with -petscfe_type basic by " + shown(f));
  else if (const double a = difference(own.values, basic.values); !(a < rounding))
    findings.push_back("the Jacobian differs with -petscfe_type basic by " + shown(a));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo::test
