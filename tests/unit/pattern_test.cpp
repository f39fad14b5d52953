// The sparsity patterns that pulmo finds, beside those of DMCreateMatrix; on any number of ranks.
#include "pulmo/solvers/fixed_stress.hpp"
#include "unit/scenes.hpp"

#include <set>

namespace pulmo::test {
namespace {

/// Columns of each row of this rank.
PetscErrorCode columns_of(Mat A, std::vector<std::set<PetscInt>> &columns)
{
  PetscInt begin, end;

  PetscFunctionBeginUser;
  PetscCall(MatGetOwnershipRange(A, &begin, &end));
  columns.assign(end - begin, {});
  for (PetscInt row = begin; row < end; ++row) {
    PetscInt n;
    const PetscInt *list;
    PetscCall(MatGetRow(A, row, &n, &list, nullptr));
    columns[row - begin].insert(list, list + n);
    PetscCall(MatRestoreRow(A, row, &n, &list, nullptr));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Rows [first, last) of the airway pressure that no field has (of a cell, alone among mesh points), on all ranks;
/// empty if there is none.
PetscErrorCode carrier_rows(DM dm, PetscInt &first, PetscInt &last)
{
  PetscSection global;
  PetscInt begin, end, range[2] = {-1, -1};

  PetscFunctionBeginUser;
  PetscCall(DMGetGlobalSection(dm, &global));
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
  for (PetscInt c = begin; c < end; ++c) {
    PetscInt dof, offset;
    PetscCall(PetscSectionGetDof(global, c, &dof));
    PetscCall(PetscSectionGetOffset(global, c, &offset));
    if (dof > 0) range[0] = offset, range[1] = offset + dof;
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, range, 2, MPIU_INT, MPI_MAX, PetscObjectComm((PetscObject)dm)));
  first = range[0];
  last = range[1];
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// @p A has the pattern that DMCreateMatrix gives @p dm, but for the carrier: its block stands alone.
void expect_stock_pattern(DM dm, Mat A)
{
  MatHandle stock;
  std::vector<std::set<PetscInt>> mine, theirs;
  PetscInt begin, first = -1, last = -1, block_size, stock_block_size;
  MatInfo info;
  PULMO_OK(DMCreateMatrix(dm, stock.out()));
  PULMO_OK(carrier_rows(dm, first, last));
  PULMO_OK(MatGetOwnershipRange(A, &begin, nullptr));
  PULMO_OK(columns_of(A, mine));
  PULMO_OK(columns_of(stock, theirs));
  ASSERT_EQ(mine.size(), theirs.size());
  for (std::size_t i = 0; i < theirs.size(); ++i) {
    const auto row = begin + static_cast<PetscInt>(i);
    if (row >= first && row < last) theirs[i].clear();
    for (PetscInt c = first; c < last; ++c) {
      theirs[i].erase(c);
      if (row >= first && row < last) theirs[i].insert(c);
    }
    EXPECT_EQ(mine[i], theirs[i]) << "row " << row;
  }
  PULMO_OK(MatGetInfo(A, MAT_LOCAL, &info));
  EXPECT_EQ(info.mallocs, 0);
  EXPECT_EQ(info.nz_unneeded, 0);
  PULMO_OK(MatGetBlockSize(A, &block_size));
  PULMO_OK(MatGetBlockSize(stock, &stock_block_size));
  EXPECT_EQ(block_size, stock_block_size);
}

TEST(Pattern, IsThatOfDMCreateMatrix)
{
  std::vector<SceneSpec> scenes;
  for (const bool airflow : {false, true})
    for (const char *mode : {"pcv", "vcv common_pressure"})
      for (const char *support : {"", "surfaces", "rigid"}) {
        SceneSpec s;
        s.airflow = airflow;
        s.ventilator = true;
        s.mode = mode;
        s.chest_wall = "full";
        s.support = support;
        scenes.push_back(s);
      }
  for (const char *mesh : {"cube_coarse.msh", "cube.msh"})
    for (const SceneSpec &scene : scenes) {
      SCOPED_TRACE(mesh + (" " + scene.text()));
      const Registry registry = Registry::standard();
      SceneRun run(registry);
      MatHandle A;
      VecHandle x, x_t;
      PULMO_OK(prepare(run, scene.options() + " -dm_plex_filename " + source(std::string("meshes/") + mesh)));
      PULMO_OK(run.model().create_matrix(A.out()));
      expect_stock_pattern(run.model().dm(), A);
      // a Jacobian finds all its entries there
      FixedStress schur;
      PULMO_OK(DMCreateLocalVector(run.model().dm(), x.out()));
      PULMO_OK(VecDuplicate(x, x_t.out()));
      PULMO_OK(MatSetOption(A, MAT_NEW_NONZERO_LOCATION_ERR, PETSC_TRUE));
      if (scene.airflow) {
        PULMO_OK(schur.setup(run.model().dm(), run.model().assembly()));
        run.model().also_fill(schur);
      }
      PULMO_OK(run.model().jacobian(0, x, x_t, 20, A));
      if (!scene.airflow) continue;
      const PetscInt field = pressure;
      DMHandle sub;
      PULMO_OK(DMCreateSubDM(run.model().dm(), 1, &field, nullptr, sub.out()));
      expect_stock_pattern(sub, schur.matrix());
    }
}

/// Types that pulmo does not fill are PETSc's affair.
TEST(Pattern, OtherMatrixTypesAreLeftToPetsc)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  MatHandle A;
  std::vector<std::set<PetscInt>> columns;
  PetscBool block;
  PULMO_OK(prepare(run, full_scene(true).options() + " -dm_mat_type baij"));
  PULMO_OK(run.model().create_matrix(A.out()));
  PULMO_OK(PetscObjectBaseTypeCompareAny((PetscObject)(Mat)A, &block, MATSEQBAIJ, MATMPIBAIJ, ""));
  EXPECT_TRUE(block);
  expect_stock_pattern(run.model().dm(), A);
}

/// The matrix of a whole scene, with random entries.
PetscErrorCode random_matrix(SceneRun &run, bool airflow, const char *mesh, Mat *A)
{
  PetscFunctionBeginUser;
  PetscCall(
      prepare(run, full_scene(airflow).options() + " -dm_plex_filename " + source(std::string("meshes/") + mesh)));
  PetscCall(run.model().create_matrix(A));
  PetscCall(MatSetRandom(*A, nullptr));
  PetscFunctionReturn(PETSC_SUCCESS);
}

TEST(Matrix, ProductIsTheSumOverItsRows)
{
  for (const bool airflow : {false, true})
    for (const char *mesh : {"cube_coarse.msh", "cube.msh"}) {
      SCOPED_TRACE(mesh);
      const Registry registry = Registry::standard();
      SceneRun run(registry);
      MatHandle A;
      VecHandle x, y, everywhere;
      VecScatter to_all;
      PetscInt begin, end;
      PULMO_OK(random_matrix(run, airflow, mesh, A.out()));
      PULMO_OK(random_direction(run, x));
      PULMO_OK(VecDuplicate(x, y.out()));
      PULMO_OK(MatMult(A, x, y));
      PULMO_OK(VecScatterCreateToAll(x, &to_all, everywhere.out()));
      PULMO_OK(VecScatterBegin(to_all, x, everywhere, INSERT_VALUES, SCATTER_FORWARD));
      PULMO_OK(VecScatterEnd(to_all, x, everywhere, INSERT_VALUES, SCATTER_FORWARD));
      PULMO_OK(VecScatterDestroy(&to_all));
      PULMO_OK(MatGetOwnershipRange(A, &begin, &end));
      const ReadArray xs(everywhere), ys(y);
      for (PetscInt row = begin; row < end; ++row) {
        PetscInt n;
        const PetscInt *column;
        const PetscScalar *entry;
        PetscScalar sum = 0, size = 1e-300;
        PULMO_OK(MatGetRow(A, row, &n, &column, &entry));
        for (PetscInt k = 0; k < n; ++k) {
          sum += entry[k] * xs[column[k]];
          size += std::abs(entry[k] * xs[column[k]]);
        }
        PULMO_OK(MatRestoreRow(A, row, &n, &column, &entry));
        ASSERT_LT(std::abs(ys[row - begin] - sum) / size, 1e-14) << "row " << row;
      }
    }
}

TEST(Matrix, BlocksOfFieldsAreRenewedAsTheyWereMade)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  MatHandle A;
  PetscInt n;
  IS *fields;
  PULMO_OK(random_matrix(run, true, "cube.msh", A.out()));
  PULMO_OK(DMCreateFieldIS(run.model().dm(), &n, nullptr, &fields));
  ASSERT_EQ(n, 2);
  for (int i = 0; i < 2; ++i)
    for (int j = 0; j < 2; ++j) {
      MatHandle kept, fresh;
      Mat block;
      PetscBool same;
      PetscReal change;
      PULMO_OK(MatCreateSubMatrix(A, fields[i], fields[j], MAT_INITIAL_MATRIX, kept.out()));
      PULMO_OK(MatNorm(kept, NORM_FROBENIUS, &change));
      PULMO_OK(MatScale(A, -2));
      block = kept;
      PULMO_OK(MatCreateSubMatrix(A, fields[i], fields[j], MAT_REUSE_MATRIX, &block));
      PULMO_OK(MatCreateSubMatrix(A, fields[i], fields[j], MAT_INITIAL_MATRIX, fresh.out()));
      PULMO_OK(MatEqual(block, fresh, &same));
      EXPECT_TRUE(same) << "block " << i << ", " << j;
      EXPECT_GT(change, 0);
    }
  for (PetscInt i = 0; i < n; ++i) PULMO_OK(ISDestroy(&fields[i]));
  PULMO_OK(PetscFree(fields));
}

} // namespace
} // namespace pulmo::test
