// The sparsity patterns that pulmo finds, beside those of DMCreateMatrix; on any number of ranks.
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

} // namespace
} // namespace pulmo::test
