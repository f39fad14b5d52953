// Parameters that differ from place to place: which cells and facets have which value, on any ranks; what sees it.
#include "unit/scenes.hpp"
#include "verification/support/lattice.hpp"

#include "pulmo/base/hdf5_image.hpp"
#include "pulmo/fem/held.hpp"
#include "pulmo/observers/energy.hpp"
#include "pulmo/observers/error_indicator.hpp"
#include "pulmo/physics/effects/viscoelastic.hpp"
#include "pulmo/physics/parameter_fields.hpp"
#include "pulmo/physics/tissue/concha.hpp"

#include <fstream>

namespace pulmo::test {
namespace {

/// A box of 2 x 1 x 1 mm, `left` of x = 1 and `right` of it. Rank 0 writes it; all ranks read it.
class Halves {
public:
  explicit Halves(int n = 2)
  {
    Lattice box = Lattice::box({2 * n, n, n}, {2, 1, 1});
    box.part = [](const Lattice::Place &x) { return x[0] < 0.5 ? "left" : "right"; };
    file_ = std::make_unique<LatticeFile>(box); // each rank its own: the content is the same
    path_ = file_->path();
  }
  std::string options() const { return "-dm_plex_filename " + path_ + " -mesh_scale 1 -pc_type lu "; }
  std::string path() const { return path_; }

private:
  std::unique_ptr<LatticeFile> file_;
  std::string path_;
};

const std::string all_but_x1 = "x0,y0,y1,z0,z1";
const std::string airflow = "-airflow -airflow_permeability 3 -airflow_surfaces x1 -chest_wall -chest_wall_surfaces " +
                            all_but_x1 + " -chest_wall_stiffness 0.3 -tissue yoshihara ";
const std::string breath = "-ventilator pcv -ventilator_pip 6 -ventilator_inspiration 0.1 -ventilator_expiration 0.1 "
                           "-ventilator_ramp 0.1 -ts_dt 0.05 ";

/// Calls visit(cell counted from 0, centroid).
template <class Visit>
PetscErrorCode for_each_cell(DM dm, Visit visit)
{
  PetscInt begin, end;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
  for (PetscInt c = begin; c < end; ++c) {
    PetscReal x[3];
    PetscCall(DMPlexComputeCellGeometryFVM(dm, c, nullptr, x, nullptr));
    visit(c - begin, x);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode signals(const std::string &options, std::vector<SignalRow> &rows)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  bool finished = false;

  PetscFunctionBeginUser;
  PetscCall(prepare(run, options));
  PetscCall(run.simulation().run(finished));
  EXPECT_TRUE(finished) << run.simulation().failure_text();
  rows = run.simulation().rows();
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// To the last bit on one rank; sums of several come in any order.
void expect_same_run(const std::vector<SignalRow> &a, const std::vector<SignalRow> &b)
{
  PetscMPIInt size;
  PULMO_OK(MPI_Comm_size(PETSC_COMM_WORLD, &size));
  ASSERT_EQ(a.size(), b.size());
  for (std::size_t i = 0; i < a.size(); ++i) {
    EXPECT_NEAR(a[i].volume, b[i].volume, size == 1 ? 0 : 1e-9 * std::abs(a[1].volume)) << i;
    EXPECT_NEAR(a[i].flow, b[i].flow, size == 1 ? 0 : 1e-7 * std::abs(a[1].flow)) << i;
  }
}

TEST(ParameterFields, ListsHaveAValueOfEachPlace)
{
  using Block = ViscoelasticKernels::Parameters;
  const Halves mesh;
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(prepare(run, mesh.options() + airflow +
                            "-viscoelastic -viscoelastic_moduli 0.5,0.3,right=0.2,0.7 -viscoelastic_times 0.1,1"));
  PULMO_OK(for_each_cell(run.model().dm(), [&](PetscInt c, const PetscReal x[3]) {
    const Block block = constants::get<Block>(run.model().constants_at(c));
    EXPECT_EQ(block.branches, 2);
    EXPECT_EQ(block.g[0], x[0] > 1 ? 0.2 : 0.5);
    EXPECT_EQ(block.g[1], x[0] > 1 ? 0.7 : 0.3);
    EXPECT_EQ(block.tau[0], 0.1);
    EXPECT_EQ(block.tau[1], 1);
  }));
  // what has the same numbers everywhere is the same run, named or not
  std::vector<SignalRow> plain, named;
  const std::string scene = mesh.options() + airflow + breath + "-ts_max_time 0.1 -viscoelastic ";
  PULMO_OK(signals(scene + "-viscoelastic_moduli 0.5,0.3 -viscoelastic_times 0.1,1", plain));
  PULMO_OK(signals(scene + "-viscoelastic_moduli 0.5,0.3,left=0.5,0.3 -viscoelastic_times 0.1,1,right=0.1,1", named));
  expect_same_run(plain, named);
}

TEST(ParameterFields, ALawOfThePorosityHasThatOfTheTissue)
{
  const Halves mesh;
  for (const auto &[given, left, right] :
       {std::tuple<const char *, double, double>{"", 0.69, 0.69}, // the law's own default
        {"-tissue_porosity 0.8", 0.8, 0.8},
        {"-tissue_porosity 0.75,right=0.6", 0.75, 0.6}}) {
    SCOPED_TRACE(given);
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    PULMO_OK(prepare(run, mesh.options() + airflow + "-tissue concha " + given));
    PULMO_OK(for_each_cell(run.model().dm(), [&, l = left, r = right](PetscInt c, const PetscReal x[3]) {
      const double expected = x[0] > 1 ? r : l;
      EXPECT_EQ(constants::get<Porosity>(run.model().constants_at(c)).reference, expected);
      EXPECT_EQ(constants::get<Concha::Parameters>(run.model().constants_at(c)).porosity, expected);
    }));
  }
}

TEST(ParameterFields, EachCellAndFacetHasItsValue)
{
  const Halves mesh;
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(prepare(run, mesh.options() + airflow +
                            "-tissue_c 1.5,right=2.5 -chest_wall_stiffness 0.3,x0=0.7,right=0.1 "
                            "-chest_wall_stiffness_z1 0.4"));
  const ParameterFields *fields = run.model().composition().varying();
  ASSERT_NE(fields, nullptr);
  // c, and one for each surface that takes the common stiffness
  ASSERT_EQ(fields->size(), 5);
  PULMO_OK(for_each_cell(run.model().dm(), [&](PetscInt c, const PetscReal x[3]) {
    std::vector<PetscReal> inside, x0, y0;
    fields->append(c, "", inside);
    fields->append(c, "x0", x0);
    fields->append(c, "y0", y0);
    const bool right = x[0] > 1;
    std::vector<PetscReal> expected(5, right ? 0.1 : 0.3);
    const auto tissue = std::find_if(inside.begin(), inside.end(), [](PetscReal v) { return v > 1; });
    ASSERT_NE(tissue, inside.end());
    expected[static_cast<std::size_t>(tissue - inside.begin())] = right ? 2.5 : 1.5;
    EXPECT_EQ(inside, expected);
    EXPECT_EQ(y0, expected);
    // the name of a surface goes before that of the volume behind it
    for (PetscReal &v : expected)
      if (v < 1) v = 0.7;
    EXPECT_EQ(x0, expected);
  }));
}

TEST(ParameterFields, OffCostsNothing)
{
  const Halves mesh;
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(prepare(run, mesh.options() + airflow + "-tissue_c 1.5"));
  EXPECT_EQ(run.model().composition().varying(), nullptr);
  EXPECT_TRUE(run.scene().mesh().places_in_file().empty());
  PlaceData *places;
  PetscDS ds;
  PULMO_OK(DMGetDS(run.model().dm(), &ds));
  PULMO_OK(PlaceData::find(ds, &places));
  EXPECT_EQ(places, nullptr); // what the integrator asks for
}

TEST(ParameterFields, TheSameValueByNameChangesNoBit)
{
  const Halves mesh;
  std::vector<SignalRow> plain, named;
  PULMO_OK(signals(mesh.options() + airflow + breath, plain));
  PULMO_OK(signals(mesh.options() + airflow + breath +
                       "-tissue_c 1.298,right=1.298 -tissue_beta 0.75,left=0.75 -airflow_permeability 3,right=3 "
                       "-chest_wall_stiffness 0.3,x0=0.3,right=0.3",
                   named));
  expect_same_run(plain, named);
}

/// The value of both halves by name is the value everywhere, and differs from another one.
TEST(ParameterFields, AllHalvesByNameAreTheWhole)
{
  const Halves mesh;
  std::vector<SignalRow> whole, named, other;
  PULMO_OK(signals(mesh.options() + airflow + breath + "-tissue_c 2", whole));
  PULMO_OK(signals(mesh.options() + airflow + breath + "-tissue_c 1,left=2,right=2", named));
  PULMO_OK(signals(mesh.options() + airflow + breath + "-tissue_c 2,right=4", other));
  EXPECT_NEAR(named[2].volume / whole[2].volume, 1, 1e-9);
  EXPECT_LT(other[2].volume, 0.95 * whole[2].volume);
}

TEST(ParameterFields, TheEnergyBalanceClosesWithRegions)
{
  const Halves mesh;
  for (const char *stiff : {"1.298,right=5", "1.298,left=100"}) {
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    Sampling sampling;
    EnergyAudit audit(run.scene(), run.model(), sampling);
    bool finished = false;
    PULMO_OK(prepare(run, "-snes_rtol 1e-14 -snes_atol 1e-12 -snes_stol 0 -snes_max_it 40 " + mesh.options() + airflow +
                              breath + "-airflow_permeability 3,left=0.2 -chest_wall_stiffness 0.3,x0=0.7,right=0.1 " +
                              "-tissue_c " + stiff));
    PULMO_OK(sampling.setup(run.model()));
    PULMO_OK(audit.setup());
    run.simulation().add(audit);
    PULMO_OK(run.simulation().run(finished));
    ASSERT_TRUE(finished);
    EXPECT_GT(audit.rows().back().ventilator_work, 0);
    EXPECT_LT(audit.rows().back().relative_residual(), 1e-9) << stiff;
  }
}

/// In a uniform deformation the stress of Darcy's law and of the tissue jumps where parameters do: recovery across the
/// interface sees an error that is not there without the jump.
TEST(ParameterFields, TheErrorIndicatorSeesThem)
{
  const Halves mesh;
  const auto indicated = [&](const std::string &more, CellErrors &errors) -> PetscErrorCode {
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    VecHandle local;
    PetscFunctionBeginUser;
    PetscCall(prepare(run, mesh.options() + airflow + more));
    PetscCall(DMCreateLocalVector(run.model().dm(), local.out()));
    PetscCall(interpolate(
        run, local,
        [](const double X[3]) {
          return std::array<double, 3>{0.1 * X[0], 0.02 * X[1], 0};
        },
        [](const double X[3]) { return 0.1 * X[0]; }));
    ErrorIndicator indicator(run.scene(), run.model());
    PetscCall(indicator.setup());
    PetscCall(indicator.estimate(local, errors));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  CellErrors uniform, tissue, flow;
  PULMO_OK(indicated("", uniform));
  PULMO_OK(indicated("-tissue_c 1.298,right=13", tissue));
  PULMO_OK(indicated("-airflow_permeability 3,right=30", flow));
  // |P|^2 is as c^2, half of the volume has ten times c
  EXPECT_NEAR(tissue.stress / uniform.stress, (1 + std::pow(13 / 1.298, 2)) / 2, 1e-6 * 50);
  // grad p . k grad p is as k
  EXPECT_NEAR(flow.dissipation / uniform.dissipation, 5.5, 1e-6);
  EXPECT_NEAR(flow.stress / uniform.stress, 1, 1e-12);
}

TEST(ParameterFields, WhatHoldsALungSeesThem)
{
  const Halves mesh;
  const auto free_motions = [&](const std::string &stiffness, std::size_t &n) -> PetscErrorCode {
    const Registry registry = Registry::standard();
    SceneRun run(registry);
    std::vector<HeldBody> held;
    PetscFunctionBeginUser;
    PetscCall(prepare(run, mesh.options() + "-chest_wall -chest_wall_surfaces y0 -chest_wall_stiffness " + stiffness));
    PetscCall(find_held(run.model().composition(), held));
    n = held.at(0).free.size();
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  std::size_t n = 0;
  PULMO_OK(free_motions("0,right=0.1", n));
  EXPECT_EQ(n, 0u);
  PULMO_OK(free_motions("0,y0=0.1", n));
  EXPECT_EQ(n, 0u);
  PULMO_OK(free_motions("0,right=0", n));
  EXPECT_EQ(n, 6u);
  PULMO_OK(free_motions("0.1,left=0,right=0", n));
  EXPECT_EQ(n, 6u);
}

// ------------------------------------------------------------------------------------------- FILE:dataset

/// An HDF5 file with a value for each cell of a MSH 2.2 file, made of its centroid.
class Dataset {
public:
  template <class Value>
  Dataset(const std::string &mesh, Value value)
  {
    std::vector<std::array<double, 3>> nodes;
    std::vector<double> values;
    std::ifstream in(mesh);
    std::string line;
    while (std::getline(in, line) && line != "$Nodes") {
    }
    std::size_t n, id;
    in >> n;
    nodes.resize(n);
    for (auto &x : nodes) in >> id >> x[0] >> x[1] >> x[2];
    while (std::getline(in, line) && line != "$Elements") {
    }
    in >> n;
    std::getline(in, line);
    for (std::size_t i = 0; i < n; ++i) {
      std::getline(in, line);
      std::istringstream words(line);
      int type, tags, tag, node;
      words >> id >> type >> tags;
      if (type != 4) continue;
      for (int k = 0; k < tags; ++k) words >> tag;
      std::array<double, 3> x{0, 0, 0};
      for (int k = 0; k < 4; ++k) {
        words >> node;
        for (int d = 0; d < 3; ++d) x[d] += nodes[static_cast<std::size_t>(node) - 1][d] / 4;
      }
      values.push_back(value(x.data()));
    }
    path_ = mesh + ".h5";
    const Hdf5Id file(H5Fcreate(path_.c_str(), H5F_ACC_TRUNC, H5P_DEFAULT, H5P_DEFAULT), H5Fclose);
    EXPECT_TRUE(write_hdf5(file, "group/c", H5T_NATIVE_DOUBLE, {values.size()}, values.data(), false));
    least_ = *std::min_element(values.begin(), values.end());
  }
  ~Dataset() { std::remove(path_.c_str()); }
  std::string text() const { return path_ + ":group/c"; }
  double least() const { return least_; }

private:
  std::string path_;
  double least_ = 0;
};

TEST(ParameterFields, ADatasetGoesToItsCells)
{
  const auto value = [](const double x[3]) { return 1 + x[0] + 0.01 * x[1] + 0.0001 * x[2]; };
  const Halves mesh;
  const Dataset data(mesh.path(), value);
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(prepare(run, mesh.options() + airflow + "-tissue_c " + data.text()));
  const ParameterFields *fields = run.model().composition().varying();
  ASSERT_NE(fields, nullptr);
  PULMO_OK(for_each_cell(run.model().dm(), [&](PetscInt c, const PetscReal x[3]) {
    std::vector<PetscReal> row;
    fields->append(c, "", row);
    ASSERT_EQ(row.size(), 1u);
    EXPECT_NEAR(row[0], value(x), 1e-13);
  }));
  // rows are scaled by the law's modulus at the softest place, 4 c (1 + beta)
  EXPECT_NEAR(run.model().modulus() / (4 * 1.75 * data.least()), 1, 1e-12);
}

/// Each piece of a refined cell has the cell's value.
TEST(ParameterFields, ADatasetIsInheritedByPieces)
{
  const Halves mesh(1);
  const Dataset data(mesh.path(), [](const double x[3]) { return 1 + x[0] + 0.01 * x[1] + 0.0001 * x[2]; });
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PULMO_OK(prepare(run, mesh.options() + airflow + "-dm_refine 1 -tissue_c " + data.text()));
  const std::vector<PetscInt> &places = run.scene().mesh().places_in_file();
  double sums[13][4] = {}; // of each cell of the file: pieces, their centroids
  PULMO_OK(for_each_cell(run.model().dm(), [&](PetscInt c, const PetscReal x[3]) {
    ++sums[places[c]][0];
    for (int d = 0; d < 3; ++d) sums[places[c]][1 + d] += x[d] / 8;
  }));
  PULMO_OK(MPI_Allreduce(MPI_IN_PLACE, sums, 13 * 4, MPI_DOUBLE, MPI_SUM, PETSC_COMM_WORLD));
  for (int cell = 0; cell < 12; ++cell) EXPECT_EQ(sums[cell][0], 8) << cell;
  // the mean of the pieces' centroids is that of the cell, whose value the pieces have
  PULMO_OK(for_each_cell(run.model().dm(), [&](PetscInt c, const PetscReal *) {
    std::vector<PetscReal> row;
    run.model().composition().varying()->append(c, "", row);
    const double *s = sums[places[c]];
    EXPECT_NEAR(row[0], 1 + s[1] + 0.01 * s[2] + 0.0001 * s[3], 1e-13);
  }));
}

/// A dataset that says what the names say is the same run.
TEST(ParameterFields, ADatasetOfTwoValuesIsTwoRegions)
{
  const Halves mesh;
  const Dataset data(mesh.path(), [](const double x[3]) { return x[0] < 1 ? 2. : 4.; });
  std::vector<SignalRow> named, listed;
  PULMO_OK(signals(mesh.options() + airflow + breath + "-tissue_c 3,left=2,right=4", named));
  PULMO_OK(signals(mesh.options() + airflow + breath + "-tissue_c " + data.text(), listed));
  expect_same_run(named, listed);
}

} // namespace
} // namespace pulmo::test
