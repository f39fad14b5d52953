/// @file
/// Every combination of effects on the small cube, and states of them.
#pragma once

#include "support/scene.hpp"
#include "unit/tensors.hpp"

namespace pulmo::test {

/// Inside a test `Run` means testing::Test::Run.
using SceneRun = pulmo::Run;

/// A combination of effects on meshes/cube_coarse.msh (24 cells, faces x0 ... z1 of the unit cube).
struct SceneSpec {
  bool airflow = false, lumen_pressure = false, ventilator = false, traction = false;
  std::string mode = "pcv"; ///< of the ventilator: also vcv, vcv common_pressure
  bool tube = false;
  std::string chest_wall; ///< full, normal or none
  std::string support;    ///< surfaces, rigid or none
  std::string law = "birzle";
  std::string more; ///< further options

  std::string options() const
  {
    std::string s =
        "-dm_plex_filename " + source("meshes/cube_coarse.msh") + " -mesh_scale 1 -pc_type lu -tissue " + law;
    if (airflow) s += " -airflow -airflow_permeability 0.7 -airflow_surfaces x1";
    if (ventilator)
      s += mode == "pcv" ? " -ventilator pcv -ventilator_pip 6" : " -ventilator vcv -ventilator_tidal_volume 1e-3";
    if (mode != "pcv")
      s += mode == "vcv" ? " -ventilator_flow_split uniform" : " -ventilator_flow_split common_pressure";
    if (tube) s += " -tube -tube_k1 3";
    if (!chest_wall.empty())
      s += " -chest_wall -chest_wall_surfaces x0,z1 -chest_wall_stiffness 0.08 -chest_wall_stiffness_z1 0.21"
           " -chest_wall_direction " +
           chest_wall;
    s += lumen_pressure ? " -lumen_pressure -lumen_pressure_surfaces x1,z1" : " -lumen_pressure off";
    if (traction)
      s += " -traction -traction_surfaces y0,x0 -traction_value 0.1,-0.2,0.05 -traction_value_y0 0.03,0.3,0.02";
    if (support == "surfaces")
      s += " -support -support_surfaces y1,z0 -support_components_z0 xz -support_displacement_y1 0.01,0.02,-0.01"
           " -support_displacement_z0 0.01,0,-0.01";
    if (support == "rigid") s += " -support -support_rigid";
    return s + " " + more;
  }
  std::string text() const
  {
    return law + (airflow ? " airflow" : "") + (ventilator ? " ventilator:" + mode : "") + (tube ? " tube" : "") +
           (chest_wall.empty() ? "" : " chest_wall:" + chest_wall) + (lumen_pressure ? " lumen_pressure" : "") +
           (traction ? " traction" : "") + (support.empty() ? "" : " support:" + support) + " " + more;
  }
};

/// All 126 combinations that pulmo admits (lumen pressure needs a gas).
inline std::vector<SceneSpec> all_scenes()
{
  std::vector<SceneSpec> list;
  for (int bits = 0; bits < 16; ++bits)
    for (const char *chest_wall : {"", "full", "normal"})
      for (const char *support : {"", "surfaces", "rigid"}) {
        SceneSpec s;
        s.airflow = bits & 1;
        s.ventilator = bits & 2;
        s.lumen_pressure = bits & 4;
        s.traction = bits & 8;
        s.chest_wall = chest_wall;
        s.support = support;
        if (s.lumen_pressure && !s.airflow && !s.ventilator) continue;
        list.push_back(s);
      }
  return list;
}

/// What flow phases and a tube bring, over scenes with and without airflow, wall pressure and supports.
inline std::vector<SceneSpec> flow_scenes()
{
  std::vector<SceneSpec> list;
  for (const char *mode : {"pcv", "vcv", "vcv common_pressure"})
    for (int bits = 0; bits < 8; ++bits)
      for (const char *support : {"", "surfaces", "rigid"}) {
        SceneSpec s;
        s.ventilator = true;
        s.mode = mode;
        s.airflow = bits & 1;
        s.tube = bits & 2;
        s.lumen_pressure = bits & 4;
        s.chest_wall = "full";
        s.support = support;
        if (s.mode != "pcv" || s.tube) list.push_back(s);
      }
  return list;
}

/// Everything at once, with or without airflow.
inline SceneSpec full_scene(bool airflow, const std::string &law = "birzle")
{
  SceneSpec s;
  s.airflow = airflow;
  s.ventilator = s.lumen_pressure = s.traction = true;
  s.chest_wall = "normal";
  s.support = "surfaces";
  s.law = law;
  return s;
}

using VectorFunction = std::function<std::array<double, 3>(const double[3])>;
using ScalarFunction = std::function<double(const double[3])>;

/// Calls visit(local dof, field, component, node coordinates) for every dof of a local vector.
template <class Visit>
PetscErrorCode for_each_dof(Run &run, Visit visit)
{
  PetscSection section;
  PetscInt begin, end, n_fields;
  std::vector<std::array<PetscReal, 3>> nodes;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(run.model().dm(), &section));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  PetscCall(PetscSectionGetNumFields(section, &n_fields));
  for (PetscInt p = begin; p < end; ++p)
    for (PetscInt f = 0; f < n_fields; ++f) {
      PetscInt dof, offset, components;
      PetscCall(PetscSectionGetFieldComponents(section, f, &components));
      PetscCall(PetscSectionGetFieldDof(section, p, f, &dof));
      PetscCall(PetscSectionGetFieldOffset(section, p, f, &offset));
      PetscCall(node_coordinates(run.model().dm(), p, dof / components, nodes));
      for (const auto &x : nodes)
        for (PetscInt c = 0; c < components; ++c) visit(offset++, f, c, x.data());
    }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Nodal values of u and p into a local vector.
inline PetscErrorCode interpolate(Run &run, Vec local, const VectorFunction &u, const ScalarFunction &p)
{
  PetscFunctionBeginUser;
  WriteArray values(local);
  PetscCall(for_each_dof(run, [&](PetscInt dof, PetscInt field, PetscInt component, const PetscReal x[3]) {
    values[dof] = field == displacement ? u(x)[component] : p(x);
  }));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// An admissible state with rates, and the work vectors to move it.
struct State {
  PetscReal t = 0.02, dt = 0.13, airway_pressure = 0.45;
  VecHandle x, x_t; ///< local, constrained values in place
  VecHandle residual, work, work_t;
};

/// A random state with J > 0: a moderate affine deformation and noise at every node, another one before the step.
inline PetscErrorCode random_state(Run &run, unsigned seed, State &s)
{
  Random random(seed);
  VecHandle before;
  Measures measures;
  Model &model = run.model();

  PetscFunctionBeginUser;
  PetscCall(DMCreateLocalVector(model.dm(), s.x.out()));
  PetscCall(VecDuplicate(s.x, s.x_t.out()));
  PetscCall(VecDuplicate(s.x, s.residual.out()));
  PetscCall(VecDuplicate(s.x, s.work.out()));
  PetscCall(VecDuplicate(s.x, s.work_t.out()));
  PetscCall(VecDuplicate(s.x, before.out()));
  for (Vec v : {(Vec)before, (Vec)s.x}) {
    double noise = 0.012;
    do {
      const Tensor G = random.tensor(0.06);
      const double inflation = random(0.02, 0.1);
      PetscCall(interpolate(
          run, v,
          [&](const double X[3]) {
            std::array<double, 3> u;
            for (int i = 0; i < 3; ++i)
              u[i] = inflation * X[i] + G[3 * i] * X[0] + G[3 * i + 1] * X[1] + G[3 * i + 2] * X[2] +
                     random(-noise, noise);
            return u;
          },
          [&](const double X[3]) { return 0.4 + 0.2 * X[0] - 0.3 * X[2] + random(-0.1, 0.1); }));
      PetscCall(model.constrain(v == before ? s.t - s.dt : s.t, v));
      PetscCall(model.measure(v, measures));
      noise *= 0.8;
    } while (!(measures.min_J > 0.3));
  }
  PetscCall(VecWAXPY(s.x_t, -1, before, s.x));
  PetscCall(VecScale(s.x_t, 1 / s.dt));
  PetscCall(model.set_step(s.dt, s.airway_pressure));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Global residual of the state moved by h d (d global), rates by shift h d; null d: the state itself.
inline PetscErrorCode residual_at(Run &run, State &s, Vec d, PetscReal h, PetscReal shift, Vec F)
{
  DM dm = run.model().dm();

  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(s.work));
  if (d) PetscCall(DMGlobalToLocal(dm, d, INSERT_VALUES, s.work));
  PetscCall(VecWAXPY(s.work_t, h * shift, s.work, s.x_t));
  PetscCall(VecAYPX(s.work, h, s.x));
  PetscCall(run.model().residual(s.t, s.work, s.work_t, s.residual));
  PetscCall(VecZeroEntries(F));
  PetscCall(DMLocalToGlobal(dm, s.residual, ADD_VALUES, F));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// A random direction, entries between -1 and 1.
inline PetscErrorCode random_direction(Run &run, VecHandle &d)
{
  PetscRandom numbers;

  PetscFunctionBeginUser;
  PetscCall(DMCreateGlobalVector(run.model().dm(), d.out()));
  PetscCall(PetscRandomCreate(PETSC_COMM_WORLD, &numbers));
  PetscCall(PetscRandomSetInterval(numbers, -1, 1));
  PetscCall(VecSetRandom(d, numbers));
  PetscCall(PetscRandomDestroy(&numbers));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// By how much A d differs from the difference of residuals along d, and the size of that. @p residual(h, F): the
/// residual of the state moved by h d.
template <class Residual>
PetscErrorCode compare_jacobian(Run &run, const State &s, const Stage &stage, Vec d, Residual residual,
                                PetscReal &difference, PetscReal &size)
{
  constexpr PetscReal h = 1e-5;
  MatHandle A;
  VecHandle product, forward, backward;

  PetscFunctionBeginUser;
  for (VecHandle *v : {&product, &forward, &backward}) PetscCall(VecDuplicate(d, v->out()));
  PetscCall(run.model().create_matrix(A.out()));
  PetscCall(run.model().set_step(stage, s.airway_pressure));
  PetscCall(run.model().jacobian(s.t, s.x, s.x_t, stage.slope, A));
  PetscCall(MatMult(A, d, product));
  PetscCall(residual(h, forward));
  PetscCall(residual(-h, backward));
  PetscCall(VecAXPY(forward, -1, backward));
  PetscCall(VecScale(forward, 0.5 / h));
  PetscCall(VecNorm(forward, NORM_2, &size));
  PetscCall(VecAXPY(forward, -1, product));
  PetscCall(VecNorm(forward, NORM_2, &difference));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Field and mesh point of every global dof.
inline PetscErrorCode places_of_dofs(Run &run, std::vector<PetscInt> &fields, std::vector<PetscInt> &points)
{
  PetscFunctionBeginUser;
  for (bool point : {false, true}) {
    VecHandle local, global;
    PetscSection section;
    PetscInt n, begin, end;
    std::vector<PetscInt> &list = point ? points : fields;
    PetscCall(DMCreateLocalVector(run.model().dm(), local.out()));
    PetscCall(DMCreateGlobalVector(run.model().dm(), global.out()));
    PetscCall(DMGetLocalSection(run.model().dm(), &section));
    PetscCall(PetscSectionGetChart(section, &begin, &end));
    {
      WriteArray values(local);
      for (PetscInt p = begin; p < end; ++p)
        for (PetscInt f = 0; f < (PetscInt)run.model().composition().fields().size(); ++f) {
          PetscInt dof, offset;
          PetscCall(PetscSectionGetFieldDof(section, p, f, &dof));
          PetscCall(PetscSectionGetFieldOffset(section, p, f, &offset));
          for (PetscInt d = 0; d < dof; ++d) values[offset + d] = point ? p : f;
        }
    }
    PetscCall(DMLocalToGlobal(run.model().dm(), local, INSERT_VALUES, global));
    PetscCall(VecGetLocalSize(global, &n));
    const ReadArray values(global);
    list.clear();
    for (PetscInt i = 0; i < n; ++i) list.push_back(static_cast<PetscInt>(values[i]));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo::test
