// "Only what a scene calls for": fields, callbacks, boundaries, rows, entries, constraints of every combination of
// effects, counted independently of pulmo; Assembly::measure.
#include "unit/scenes.hpp"

#include <petsc/private/petscdsimpl.h>

#include <limits>
#include <numeric>
#include <set>

namespace pulmo::test {
namespace {

/// What the effects of a scene bring, effect by effect.
struct Expected {
  // volume callbacks: residuals f0, f1 of each test field, Jacobians g0 ... g3 of each pair
  int f[2][2] = {{0, 0}, {0, 0}}, g[2][2][4] = {};
  std::map<std::pair<std::string, int>, int> bd_f0;   // by surface and row
  std::map<std::string, std::array<int, 2>> bd_g0_g1; // displacement, displacement
  std::map<std::string, int> bd_g0_pressure;          // displacement, pressure
  std::set<std::string> owners{"step", "tissue"};     // blocks of parameters
  int carrier = 0;                                    // dofs for a uniform gas pressure that is an unknown

  explicit Expected(const SceneSpec &s)
  {
    f[0][1] = 1; // tissue
    g[0][0][3] = 1;
    if (s.airflow) {
      f[0][1] += 1; // gas stress
      f[1][0] += 1; // porosity rate
      f[1][1] += 1; // flux
      g[0][0][3] += 1;
      g[0][1][2] += 1;
      g[1][0][1] += 1;
      g[1][0][3] += 1;
      g[1][1][3] += 1;
      owners.insert("permeability");
      owners.insert("porosity"); // for fields and summary
    }
    if (s.ventilator && !s.airflow) { // uniform gas
      f[0][1] += 1;
      g[0][0][3] += 1;
      if (s.mode != "pcv" || s.tube) carrier = 3; // one is used
    }
    if (s.airflow && s.mode == "vcv") bd_f0[{"x1", 1}] += 1; // flux; a common pressure and a tube bring no term at all
    if (!s.chest_wall.empty()) {
      owners.insert("chest_wall");
      for (const char *surface : {"x0", "z1"}) {
        bd_f0[{surface, 0}] += 1;
        bd_g0_g1[surface][0] += 1;
      }
    }
    if (s.lumen_pressure)
      for (const char *surface : {"x1", "z1"}) {
        bd_f0[{surface, 0}] += 1;
        bd_g0_g1[surface][1] += 1;
        if (s.airflow) bd_g0_pressure[surface] += 1;
      }
    if (s.traction) {
      owners.insert("traction");
      for (const char *surface : {"y0", "x0"}) bd_f0[{surface, 0}] += 1;
    }
  }
  int volume_residuals() const { return f[0][0] + f[0][1] + f[1][0] + f[1][1]; }
  int volume_jacobians() const
  {
    int n = 0;
    for (const auto &row : g)
      for (const auto &pair : row)
        for (int count : pair) n += count;
    return n;
  }
};

/// All callbacks in a weak form, whatever their key.
int callbacks_in(PetscWeakForm wf)
{
  int n = 0;
  for (int kind = 0; kind < PETSC_NUM_WF; ++kind) {
    PetscInt size = 0, offset = 0;
    (void)PetscHMapFormGetSize(wf->form[kind], &size);
    std::vector<PetscFormKey> keys(static_cast<std::size_t>(size));
    (void)PetscHMapFormGetKeys(wf->form[kind], &offset, keys.data());
    for (const PetscFormKey &key : keys) {
      PetscChunk chunk;
      (void)PetscHMapFormGet(wf->form[kind], key, &chunk);
      n += static_cast<int>(chunk.size);
    }
  }
  return n;
}

void expect_callbacks(SceneRun &run, const SceneSpec &scene)
{
  const Expected expected(scene);
  PetscDS ds;
  PetscWeakForm volume;
  PetscInt n, n_fields;
  PULMO_OK(DMGetDS(run.model().dm(), &ds));
  PULMO_OK(PetscDSGetNumFields(ds, &n_fields));
  ASSERT_EQ(n_fields, scene.airflow ? 2 : 1);
  PULMO_OK(DMGetNumFields(run.model().dm(), &n));
  EXPECT_EQ(n, n_fields);

  PULMO_OK(PetscDSGetWeakForm(ds, &volume));
  for (PetscInt f = 0; f < n_fields; ++f) {
    PetscInt n0, n1;
    PetscPointFunc *f0, *f1;
    PULMO_OK(PetscWeakFormGetResidual(volume, nullptr, 0, f, 0, &n0, &f0, &n1, &f1));
    EXPECT_EQ(n0, expected.f[f][0]) << "f0 of field " << f;
    EXPECT_EQ(n1, expected.f[f][1]) << "f1 of field " << f;
    for (PetscInt g = 0; g < n_fields; ++g) {
      PetscInt count[4];
      PetscPointJac *g0, *g1, *g2, *g3;
      PULMO_OK(PetscWeakFormGetJacobian(volume, nullptr, 0, f, g, 0, &count[0], &g0, &count[1], &g1, &count[2], &g2,
                                        &count[3], &g3));
      for (int k = 0; k < 4; ++k) EXPECT_EQ(count[k], expected.g[f][g][k]) << "g" << k << " of fields " << f << g;
    }
  }
  EXPECT_EQ(callbacks_in(volume), expected.volume_residuals() + expected.volume_jacobians());

  // one natural boundary per surface that carries a term, nothing else on it
  PetscInt n_boundaries;
  std::set<std::pair<std::string, int>> seen;
  PULMO_OK(PetscDSGetNumBoundary(ds, &n_boundaries));
  EXPECT_EQ(n_boundaries, static_cast<PetscInt>(expected.bd_f0.size()));
  for (PetscInt b = 0; b < n_boundaries; ++b) {
    PetscWeakForm wf;
    DMBoundaryConditionType type;
    const char *name;
    DMLabel label;
    PetscInt n_values, field, n0, n1, m[4];
    const PetscInt *values;
    PetscBdPointFunc *f0, *f1;
    PetscBdPointJac *g0, *g1, *g2, *g3;
    PULMO_OK(PetscDSGetBoundary(ds, b, &wf, &type, &name, &label, &n_values, &values, &field, nullptr, nullptr, nullptr,
                                nullptr, nullptr));
    SCOPED_TRACE(name);
    EXPECT_EQ(type, DM_BC_NATURAL);
    const std::pair<std::string, int> key{name, static_cast<int>(field)};
    EXPECT_TRUE(seen.insert(key).second);
    ASSERT_EQ(expected.bd_f0.count(key), 1u);
    ASSERT_EQ(n_values, 1);
    PULMO_OK(PetscWeakFormGetBdResidual(wf, label, values[0], field, 0, &n0, &f0, &n1, &f1));
    EXPECT_EQ(n0, expected.bd_f0.at(key));
    EXPECT_EQ(n1, 0);
    int total = expected.bd_f0.at(key);
    if (field == pressure) { // a prescribed flux depends on nothing
      EXPECT_EQ(callbacks_in(wf), total);
      continue;
    }
    const auto tangent = expected.bd_g0_g1.count(name) ? expected.bd_g0_g1.at(name) : std::array<int, 2>{0, 0};
    PULMO_OK(PetscWeakFormGetBdJacobian(wf, label, values[0], 0, 0, 0, &m[0], &g0, &m[1], &g1, &m[2], &g2, &m[3], &g3));
    EXPECT_EQ(m[0], tangent[0]);
    EXPECT_EQ(m[1], tangent[1]);
    EXPECT_EQ(m[2] + m[3], 0);
    total += tangent[0] + tangent[1];
    if (scene.airflow) {
      const int by_pressure = expected.bd_g0_pressure.count(name) ? expected.bd_g0_pressure.at(name) : 0;
      PULMO_OK(
          PetscWeakFormGetBdJacobian(wf, label, values[0], 0, 1, 0, &m[0], &g0, &m[1], &g1, &m[2], &g2, &m[3], &g3));
      EXPECT_EQ(m[0], by_pressure);
      EXPECT_EQ(m[1] + m[2] + m[3], 0);
      total += by_pressure;
    }
    EXPECT_EQ(callbacks_in(wf), total);
  }

  std::set<std::string> owners{"step"};
  for (const ParameterBlock &block : run.model().composition().parameter_blocks())
    EXPECT_TRUE(owners.insert(block.owner).second) << block.owner << " twice";
  EXPECT_EQ(owners, expected.owners);
}

/// Which components are held at a node of the cube: bits 1, 2, 4 for u, 8 for p.
int held_at(const SceneSpec &scene, const PetscReal x[3])
{
  constexpr double eps = 1e-12;
  int held = 0;
  if (scene.support == "surfaces") {
    if (x[1] > 1 - eps) held |= 7;
    if (x[2] < eps) held |= 5;
  }
  if (scene.airflow && x[0] > 1 - eps) held |= 8;
  return held;
}

void expect_rows_and_entries(SceneRun &run, const SceneSpec &scene)
{
  const int carrier = Expected(scene).carrier; // on the first cell
  const DM dm = run.model().dm();
  PetscSection section;
  PetscInt begin, end, vertex_begin, vertex_end, edge_begin, edge_end, n_components;
  std::map<PetscInt, int> free; // free dofs of a mesh point
  int pinned = 0, rows = 0;
  std::vector<std::array<double, 6>> pins; // rigid motions (3 translations, 3 rotations) at the pinned components

  PULMO_OK(DMGetLocalSection(dm, &section));
  PULMO_OK(PetscSectionGetChart(section, &begin, &end));
  PULMO_OK(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  PULMO_OK(DMPlexGetDepthStratum(dm, 1, &edge_begin, &edge_end));
  PULMO_OK(PetscSectionGetFieldComponents(section, 0, &n_components));
  EXPECT_EQ(n_components, 3);
  for (PetscInt p = begin; p < end; ++p) {
    const bool vertex = p >= vertex_begin && p < vertex_end, edge = p >= edge_begin && p < edge_end;
    PetscInt dof, constrained;
    PetscReal x[3];
    PULMO_OK(PetscSectionGetDof(section, p, &dof));
    ASSERT_EQ(dof, vertex ? (scene.airflow ? 4 : 3) : edge ? 3 : p == 0 ? carrier : 0) << "mesh point " << p;
    PULMO_OK(PetscSectionGetConstraintDof(section, p, &constrained));
    if (dof == 0) {
      EXPECT_EQ(constrained, 0);
      continue;
    }
    if (!vertex && !edge) { // the carrier's
      EXPECT_EQ(constrained, 0);
      rows += free[p] = carrier;
      continue;
    }
    PULMO_OK(run.scene().mesh().node_coordinates(p, x));
    const int held = held_at(scene, x); // the airway's pressure stays in the section: its rows are closed instead
    std::set<PetscInt> expected, found;
    for (int c = 0; c < 3; ++c)
      if (held & (1 << c)) expected.insert(c);
    const PetscInt *which = nullptr;
    if (constrained) {
      PULMO_OK(PetscSectionGetConstraintIndices(section, p, &which));
    }
    found.insert(which, which + constrained);
    if (scene.support == "rigid") {
      for (PetscInt c : found)
        if (c < 3 && !expected.count(c)) {
          EXPECT_TRUE(vertex);
          ++pinned;
          std::array<double, 6> motion{};
          motion[c] = 1;
          motion[3 + (c + 1) % 3] = x[(c + 2) % 3]; // omega x X
          motion[3 + (c + 2) % 3] = -x[(c + 1) % 3];
          pins.push_back(motion);
          expected.insert(c);
        }
    }
    EXPECT_EQ(found, expected) << "node at " << x[0] << " " << x[1] << " " << x[2];
    free[p] = static_cast<int>(dof - static_cast<PetscInt>(found.size()));
    rows += free[p];
  }
  // springs hold every motion, or, normal ones on x0 and z1, all but the translation along y
  const int left_free = scene.chest_wall.empty() ? 6 : scene.chest_wall == "normal" ? 1 : 0;
  EXPECT_EQ(pinned, scene.support == "rigid" ? left_free : 0);
  if (pins.size() == 6) { // the pins remove each of the six rigid motions: their matrix is regular
    double determinant = 1;
    for (int c = 0; c < 6; ++c) {
      int best = c;
      for (int r = c; r < 6; ++r)
        if (std::abs(pins[r][c]) > std::abs(pins[best][c])) best = r;
      std::swap(pins[c], pins[best]);
      determinant *= pins[c][c];
      if (pins[c][c] == 0) break;
      for (int r = c + 1; r < 6; ++r)
        for (int j = 5; j >= c; --j) pins[r][j] -= pins[r][c] / pins[c][c] * pins[c][j];
    }
    EXPECT_GT(std::abs(determinant), 1e-3);
  }

  // every pair of free dofs of fields that share a cell is an entry, and nothing else is but a carrier's own block
  std::map<PetscInt, std::set<PetscInt>> neighbours;
  for (PetscInt c = 0; c < run.model().assembly().cells(); ++c) {
    PetscInt *closure = nullptr, n;
    PULMO_OK(DMPlexGetTransitiveClosure(dm, c, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 1; i < n; ++i) // but for the cell, which comes first
      for (PetscInt j = 1; j < n; ++j)
        if (free.count(closure[2 * i]) && free.count(closure[2 * j])) neighbours[closure[2 * i]].insert(closure[2 * j]);
    PULMO_OK(DMPlexRestoreTransitiveClosure(dm, c, PETSC_TRUE, &n, &closure));
  }
  for (const auto &[point, dofs] : free) neighbours[point].insert(point);
  MatHandle A;
  State s;
  PetscInt m;
  MatInfo info;
  std::vector<PetscInt> fields, points;
  PULMO_OK(random_state(run, 3, s));
  PULMO_OK(run.model().create_matrix(A.out()));
  PULMO_OK(run.model().jacobian(s.t, s.x, s.x_t, 1 / s.dt, A));
  PULMO_OK(MatGetSize(A, &m, nullptr));
  ASSERT_EQ(m, rows);
  PULMO_OK(places_of_dofs(run, fields, points));
  double entries = 0;
  for (PetscInt row = 0; row < m; ++row) {
    PetscInt n, expected = 0;
    const PetscInt *columns;
    PULMO_OK(MatGetRow(A, row, &n, &columns, nullptr));
    const auto &near = neighbours[points[row]];
    for (PetscInt q : near) expected += free[q];
    EXPECT_EQ(n, expected) << "row " << row;
    for (PetscInt k = 0; k < n; ++k)
      EXPECT_TRUE(near.count(points[columns[k]])) << "entry " << row << ", " << columns[k];
    PULMO_OK(MatRestoreRow(A, row, &n, &columns, nullptr));
    entries += expected;
  }
  PULMO_OK(MatGetInfo(A, MAT_LOCAL, &info));
  EXPECT_EQ(info.nz_used, entries);
}

void expect_calls(SceneRun &run, const SceneSpec &scene, int points)
{
  const Expected expected(scene);
  State s;
  MatHandle A;
  PULMO_OK(random_state(run, 4, s));
  PULMO_OK(run.model().create_matrix(A.out()));
  const IntegrationLog before = run.model().assembly().log();
  PULMO_OK(run.model().residual(s.t, s.x, s.x_t, s.residual));
  PULMO_OK(run.model().jacobian(s.t, s.x, s.x_t, 1 / s.dt, A));
  const IntegrationLog &after = run.model().assembly().log();
  EXPECT_EQ(after.residual_cells - before.residual_cells, 24);
  EXPECT_EQ(after.jacobian_cells - before.jacobian_cells, 24);
  EXPECT_EQ(after.residual_calls - before.residual_calls, 24 * points * expected.volume_residuals());
  EXPECT_EQ(after.jacobian_calls - before.jacobian_calls, 24 * points * expected.volume_jacobians());
}

void expect_only_what_effects_bring(const std::vector<SceneSpec> &scenes)
{
  for (const SceneSpec &scene : scenes) {
    SCOPED_TRACE(scene.text());
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    PULMO_OK(prepare(run, scene.options()));
    expect_callbacks(run, scene);
    expect_rows_and_entries(run, scene);
    expect_calls(run, scene, 8);
    if (testing::Test::HasFailure()) return;
  }
}

TEST(Composition, EveryCombinationHasOnlyWhatItsEffectsBring)
{
  expect_only_what_effects_bring(all_scenes());
}

TEST(Composition, FlowPhasesBringAFluxOrOneUnknownAndATubeNothingElse)
{
  expect_only_what_effects_bring(flow_scenes());
}

TEST(Composition, CallbacksFollowTheRule)
{
  const std::pair<int, int> rules[] = {{3, 8}, {4, 14}}; // degree, points
  for (const auto &[degree, points] : rules)
    for (bool airflow : {false, true}) {
      SceneSpec scene = full_scene(airflow);
      scene.more = "-quadrature_degree " + std::to_string(degree);
      SCOPED_TRACE(scene.text());
      const Registry registry = Registry::standard();
      SceneRun run(registry);
      PULMO_OK(prepare(run, scene.options()));
      expect_calls(run, scene, points);
    }
}

TEST(Composition, ChestWallWithoutStiffnessBringsNothing)
{
  SceneSpec scene;
  scene.support = "rigid";
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(prepare(run, scene.options() + "-chest_wall -chest_wall_surfaces x0,z1 -chest_wall_stiffness 0"));
  PetscDS ds;
  PetscInt n;
  PULMO_OK(DMGetDS(run.model().dm(), &ds));
  PULMO_OK(PetscDSGetNumBoundary(ds, &n));
  EXPECT_EQ(n, 0);
}

TEST(Composition, PrescribedValuesArePutIntoTheState)
{
  SceneSpec scene = full_scene(true);
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  VecHandle x;
  PULMO_OK(prepare(run, scene.options()));
  PULMO_OK(DMCreateLocalVector(run.model().dm(), x.out()));
  PULMO_OK(VecSet(x, 7));
  const double t = 0.04, p = 0.235;
  PULMO_OK(run.model().set_step(0.04, p));
  PULMO_OK(run.model().constrain(t, x));
  const ReadArray values(x);
  PULMO_OK(for_each_dof(run, [&](PetscInt dof, PetscInt field, PetscInt component, const PetscReal X[3]) {
    const int held = held_at(scene, X);
    const double prescribed[3] = {0.01, 0.02, -0.01}; // z0 does not hold the second
    if (field == pressure) {
      EXPECT_NEAR(values[dof], held & 8 ? p : 7, 1e-15);
    } else if (!(held & (1 << component))) {
      EXPECT_EQ(values[dof], 7);
    } else {
      EXPECT_EQ(values[dof], prescribed[component]);
    }
  }));
}

// ------------------------------------------------------------------------------------------------- Assembly::measure

PetscErrorCode plain_scene(SceneRun &run, Vec *x, const std::string &mesh = "meshes/cube.msh")
{
  PetscFunctionBeginUser;
  PetscCall(prepare(run, "-dm_plex_filename " + source(mesh) + " -mesh_scale 1 -pc_type lu -support -support_rigid"));
  PetscCall(DMCreateLocalVector(run.model().dm(), x));
  PetscFunctionReturn(PETSC_SUCCESS);
}

TEST(Measure, VolumeOfAffineDeformationsIsExact)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  VecHandle x;
  PULMO_OK(plain_scene(run, x.out()));
  Random random(71);
  for (double J : {0.3, 1.0, 1.0 + 1e-9, 2.5}) {
    const Tensor G = random_deformation(random, J) - identity;
    const double exact = det(identity + G) - 1;
    Measures m;
    PULMO_OK(interpolate(
        run, x,
        [&](const double X[3]) {
          std::array<double, 3> u;
          for (int i = 0; i < 3; ++i) u[i] = G[3 * i] * X[0] + G[3 * i + 1] * X[1] + G[3 * i + 2] * X[2];
          return u;
        },
        [](const double *) { return 0; }));
    PULMO_OK(run.model().measure(x, m));
    EXPECT_NEAR(m.volume_change, exact, 1e-13);
    EXPECT_NEAR(m.min_J, 1 + exact, 1e-12);
    EXPECT_NEAR(m.max_J, 1 + exact, 1e-12);
    EXPECT_NEAR(m.min_J_points, 1 + exact, 1e-12);
  }
}

TEST(Measure, TinyVolumesKeepTheirDigits)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  VecHandle x;
  Measures m;
  PULMO_OK(plain_scene(run, x.out()));
  const double e = 1e-12; // det F - 1 in doubles would be wrong in the fourth digit
  PULMO_OK(interpolate(
      run, x,
      [&](const double X[3]) {
        return std::array<double, 3>{e * X[0], 2 * e * X[1], -0.5 * e * X[2]};
      },
      [](const double *) { return 0; }));
  PULMO_OK(run.model().measure(x, m));
  EXPECT_NEAR(m.volume_change, 2.5 * e, 1e-10 * e);
}

TEST(Measure, CubicVolumeIsExactWithTheDefaultRule)
{
  // u = (a X^2, b Y^2, c Z^2): J = (1 + 2 a X)(1 + 2 b Y)(1 + 2 c Z), of degree 3
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  VecHandle x;
  Measures m;
  PULMO_OK(plain_scene(run, x.out()));
  const double a = 0.3, b = -0.2, c = 0.4;
  PULMO_OK(interpolate(
      run, x,
      [&](const double X[3]) {
        return std::array<double, 3>{a * X[0] * X[0], b * X[1] * X[1], c * X[2] * X[2]};
      },
      [](const double *) { return 0; }));
  PULMO_OK(run.model().measure(x, m));
  EXPECT_NEAR(m.volume_change, (1 + a) * (1 + b) * (1 + c) - 1, 1e-13);
  // extremes at corners of the cube
  EXPECT_NEAR(m.min_J, 1 - 0.4, 1e-13);
  EXPECT_NEAR(m.max_J, 1.6 * 1.8, 1e-13);
}

TEST(Measure, SmallestJIsFoundWhereItIs)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  VecHandle x;
  Measures m;
  PULMO_OK(plain_scene(run, x.out()));
  // J = 1 - 1.2 Z^0.. : u_z = -0.6 Z^2 gives J = 1 - 1.2 Z, negative near Z = 1
  PULMO_OK(interpolate(
      run, x,
      [](const double X[3]) {
        return std::array<double, 3>{0, 0, -0.6 * X[2] * X[2]};
      },
      [](const double *) { return 0; }));
  PULMO_OK(run.model().measure(x, m));
  EXPECT_NEAR(m.min_J, -0.2, 1e-12);
  EXPECT_GT(m.min_J_points, m.min_J);
  // independently: the centroid of the reported cell is where it says, and the cell touches Z = 1
  PetscReal volume, centroid[3];
  PULMO_OK(DMPlexComputeCellGeometryFVM(run.model().dm(), m.cell, &volume, centroid, nullptr));
  for (int d = 0; d < 3; ++d) EXPECT_NEAR(m.where[d], centroid[d], 1e-12);
  EXPECT_GT(m.where[2], 0.6);

  // a single node pushed through its cell: the smallest J is in a cell that has this node
  PetscInt begin, end;
  PULMO_OK(VecZeroEntries(x));
  PULMO_OK(DMPlexGetDepthStratum(run.model().dm(), 0, &begin, &end));
  const PetscInt victim = begin + 20;
  PetscSection section;
  PetscInt offset, *closure = nullptr, n;
  PULMO_OK(DMGetLocalSection(run.model().dm(), &section));
  PULMO_OK(PetscSectionGetOffset(section, victim, &offset));
  {
    WriteArray values(x);
    values[offset] = 0.2;
  }
  PULMO_OK(run.model().measure(x, m));
  EXPECT_LT(m.min_J, 0.5);
  bool has_victim = false;
  PULMO_OK(DMPlexGetTransitiveClosure(run.model().dm(), m.cell, PETSC_TRUE, &n, &closure));
  for (PetscInt i = 0; i < n; ++i) has_victim |= closure[2 * i] == victim;
  PULMO_OK(DMPlexRestoreTransitiveClosure(run.model().dm(), m.cell, PETSC_TRUE, &n, &closure));
  EXPECT_TRUE(has_victim);
}

TEST(Measure, StatesThatAreNotNumbersAreNotPositive)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  VecHandle x;
  PULMO_OK(plain_scene(run, x.out()));
  for (bool everywhere : {false, true}) {
    SCOPED_TRACE(everywhere);
    Measures m;
    {
      WriteArray values(x);
      PetscInt n;
      PULMO_OK(VecGetLocalSize(x, &n));
      for (PetscInt i = 0; i < n; ++i)
        values[i] = everywhere || i == n / 2 ? std::numeric_limits<double>::quiet_NaN() : 0;
    }
    PULMO_OK(run.model().measure(x, m));
    EXPECT_FALSE(m.min_J > 0) << m.min_J;
    EXPECT_FALSE(m.min_J_points > 0) << m.min_J_points; // what Simulation::residual looks at
  }
}

/// A load whose parameters are handed over as often as the test says.
class Careless final : public Effect {
public:
  struct Parameters {
    static constexpr const char *owner = "test_careless";
    PetscScalar force = 1;
  };
  explicit Careless(int times) : times_(times) {}
  const char *name() const override { return "test_careless"; }
  const char *about() const override { return "load of a careless author (test)"; }
  PetscErrorCode declare(Options &options) override
  {
    options.group(name(), about());
    return PETSC_SUCCESS;
  }
  bool active() const override { return true; }
  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    for (int i = 0; i < times_; ++i) c.parameters(parameters_);
    c.residual("-f . eta", displacement, f0(volume_residual<Parameters, push>));
    return PETSC_SUCCESS;
  }

private:
  static void push(const Point &, const Parameters &k, PetscScalar f[]) { f[0] -= k.force; }

  int times_;
  Parameters parameters_;
};

TEST(Composition, ParametersAreHandedOverOnce)
{
  for (int times : {0, 1, 2}) {
    Registry registry = Registry::standard();
    registry.effect([=] { return std::make_unique<Careless>(times); });
    SceneRun run(registry);
    PULMO_OK(set_options(SceneSpec().options()));
    PULMO_OK(run.declare());
    PULMO_OK(PetscPushErrorHandler(PetscIgnoreErrorHandler, nullptr));
    const PetscErrorCode code = run.setup();
    PULMO_OK(PetscPopErrorHandler());
    EXPECT_EQ(static_cast<int>(code), times == 1 ? 0 : PETSC_ERR_ARG_WRONGSTATE) << times;
  }
}

} // namespace
} // namespace pulmo::test
