// What options files can pick: rigid-body modes, p-multigrid, the fixed-stress matrix.
#include "pulmo/solvers/displacement_block.hpp"
#include "pulmo/solvers/fixed_stress.hpp"
#include "pulmo/solvers/p1_space.hpp"
#include "pulmo/solvers/single_blocks.hpp"
#include "unit/scenes.hpp"

#include <petsc/private/petscimpl.h>

namespace pulmo::test {
namespace {

constexpr const char *springs = " -chest_wall -chest_wall_surfaces x0,y1 -chest_wall_stiffness 0.3 ";

std::string cube(const std::string &mesh)
{
  return "-dm_plex_filename " + source("meshes/" + mesh) + " -mesh_scale 1 -tissue yoshihara -pc_type gamg ";
}

/// The Jacobian of a scene at rest, step 0.05 s, no gas pressure.
PetscErrorCode jacobian_at_rest(SceneRun &run, Mat *A)
{
  VecHandle x, x_t;

  PetscFunctionBeginUser;
  PetscCall(DMCreateLocalVector(run.model().dm(), x.out()));
  PetscCall(VecDuplicate(x, x_t.out()));
  PetscCall(run.model().create_matrix(A));
  PetscCall(run.model().set_step(0.05, 0));
  PetscCall(run.model().jacobian(0, x, x_t, 20, *A));
  PetscFunctionReturn(PETSC_SUCCESS);
}

TEST(RigidBodyModes, AFreeBodyAtRestDoesNotResistThem)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  MatHandle A;
  VecHandle force;
  MatNullSpace modes;
  const Vec *v;
  PetscInt n;
  PetscReal size;
  PULMO_OK(prepare(run, cube("cube.msh")));
  PULMO_OK(jacobian_at_rest(run, A.out()));
  PULMO_OK(MatGetNearNullSpace(A, &modes));
  ASSERT_NE(modes, nullptr);
  PULMO_OK(MatNullSpaceGetVecs(modes, nullptr, &n, &v));
  ASSERT_EQ(n, 6);
  PULMO_OK(MatNorm(A, NORM_INFINITY, &size));
  PULMO_OK(VecDuplicate(v[0], force.out()));
  for (PetscInt i = 0; i < n; ++i) {
    PetscReal f;
    PULMO_OK(MatMult(A, v[i], force));
    PULMO_OK(VecNorm(force, NORM_INFINITY, &f));
    EXPECT_LT(f, 1e-13 * size) << "mode " << i;
  }
}

TEST(RigidBodyModes, TheDisplacementSplitCarriesThem)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  PetscInt n;
  IS *splits;
  DM *dms; // asked for, as PCFIELDSPLIT does
  PetscObject modes = nullptr;
  PULMO_OK(prepare(run, cube("cube.msh") + springs + "-airflow -airflow_surfaces x1"));
  PULMO_OK(DMCreateFieldDecomposition(run.model().dm(), &n, nullptr, &splits, &dms));
  ASSERT_EQ(n, 2);
  PULMO_OK(PetscObjectQuery((PetscObject)splits[0], "nearnullspace", &modes));
  EXPECT_NE(modes, nullptr);
  PULMO_OK(PetscObjectQuery((PetscObject)splits[1], "nearnullspace", &modes));
  EXPECT_EQ(modes, nullptr);
  for (PetscInt i = 0; i < n; ++i) {
    PULMO_OK(ISDestroy(&splits[i]));
    PULMO_OK(DMDestroy(&dms[i]));
  }
  PULMO_OK(PetscFree(dms));
  PULMO_OK(PetscFree(splits));
}

/// Iterations of CG to 1e-8 with the preconditioner of the options, on @p mesh.
int iterations(const std::string &mesh, const std::string &more)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  MatHandle A;
  VecHandle b, x;
  KSP ksp;
  PetscInt n = -1;
  KSPConvergedReason reason;
  const auto solve = [&]() -> PetscErrorCode {
    PetscFunctionBeginUser;
    PetscCall(prepare(run, cube(mesh) + more));
    PetscCall(jacobian_at_rest(run, A.out()));
    PetscCall(MatCreateVecs(A, x.out(), b.out()));
    PetscCall(VecSetRandom(b, nullptr));
    PetscCall(KSPCreate(PETSC_COMM_WORLD, &ksp));
    PetscCall(KSPSetDM(ksp, run.model().dm()));
    PetscCall(pulmo::compat::keep_operators(ksp));
    PetscCall(KSPSetOperators(ksp, A, A));
    PetscCall(KSPSetOptionsPrefix(ksp, "test_"));
    PetscCall(KSPSetTolerances(ksp, 1e-8, PETSC_DEFAULT, PETSC_DEFAULT, 2000));
    PetscCall(KSPSetType(ksp, KSPCG));
    PetscCall(KSPSetFromOptions(ksp));
    PetscCall(KSPSolve(ksp, b, x));
    PetscCall(KSPGetIterationNumber(ksp, &n));
    PetscCall(KSPGetConvergedReason(ksp, &reason));
    PetscCall(KSPDestroy(&ksp));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  EXPECT_EQ(static_cast<int>(solve()), 0);
  EXPECT_GT(reason, 0) << more;
  return static_cast<int>(n);
}

/// Largest difference of two vectors relative to the largest entry of the first one.
PetscReal relative_difference(Vec a, Vec b)
{
  PetscReal size = 0, difference = 0;
  VecHandle d;
  const auto compare = [&]() -> PetscErrorCode {
    PetscFunctionBeginUser;
    PetscCall(VecNorm(a, NORM_INFINITY, &size));
    PetscCall(VecDuplicate(a, d.out()));
    PetscCall(VecWAXPY(d, -1, a, b));
    PetscCall(VecNorm(d, NORM_INFINITY, &difference));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  EXPECT_EQ(static_cast<int>(compare()), 0);
  return difference / size;
}

TEST(SingleBlocks, MultiplyAndSmoothAsPetscDoesInDouble)
{
  constexpr PetscReal float_precision = 2e-6;
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  MatHandle A, blocks, single;
  VecHandle x, y, b, expected, result;
  PULMO_OK(prepare(run, cube("cube.msh") + springs));
  PULMO_OK(jacobian_at_rest(run, A.out()));
  PULMO_OK(MatConvert(A, MATBAIJ, MAT_INITIAL_MATRIX, blocks.out()));
  PULMO_OK(create_single_blocks(A, nullptr, single.out()));
  PULMO_OK(MatCreateVecs(A, x.out(), b.out()));
  for (VecHandle *v : {&y, &expected, &result}) PULMO_OK(VecDuplicate(x, v->out()));
  PULMO_OK(VecSetRandom(x, nullptr));
  PULMO_OK(VecSetRandom(b, nullptr));

  PULMO_OK(MatMult(A, x, expected));
  PULMO_OK(MatMult(single, x, result));
  EXPECT_LT(relative_difference(expected, result), float_precision);
  PULMO_OK(MatResidual(A, b, x, expected));
  PULMO_OK(MatResidual(single, b, x, result));
  EXPECT_LT(relative_difference(expected, result), float_precision);
  PULMO_OK(MatGetDiagonal(A, expected));
  PULMO_OK(MatGetDiagonal(single, result));
  EXPECT_LT(relative_difference(expected, result), float_precision);

  for (const int direction : {SOR_LOCAL_FORWARD_SWEEP, SOR_LOCAL_BACKWARD_SWEEP, SOR_LOCAL_SYMMETRIC_SWEEP})
    for (const int from_zero : {0, (int)SOR_ZERO_INITIAL_GUESS})
      for (const PetscInt sweeps : {1, 3}) {
        const auto type = static_cast<MatSORType>(direction | from_zero);
        PULMO_OK(VecCopy(x, expected));
        PULMO_OK(VecCopy(x, result));
        PULMO_OK(MatSOR(blocks, b, 1, type, 0, sweeps, 1, expected));
        PULMO_OK(MatSOR(single, b, 1, type, 0, sweeps, 1, result));
        EXPECT_LT(relative_difference(expected, result), 10 * float_precision)
            << "sweep " << direction << ", zero guess " << from_zero << ", times " << sweeps;
      }
}

TEST(SingleBlocks, FollowTheMatrix)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  MatHandle A, single;
  VecHandle x, expected, result;
  PULMO_OK(prepare(run, cube("cube_coarse.msh") + springs));
  PULMO_OK(jacobian_at_rest(run, A.out()));
  PULMO_OK(create_single_blocks(A, nullptr, single.out()));
  PULMO_OK(MatCreateVecs(A, x.out(), expected.out()));
  PULMO_OK(VecDuplicate(x, result.out()));
  PULMO_OK(VecSetRandom(x, nullptr));
  PULMO_OK(MatScale(A, -3));
  PULMO_OK(MatShift(A, 0.25));
  PULMO_OK(update_single_blocks(single, A));
  PULMO_OK(MatMult(A, x, expected));
  PULMO_OK(MatMult(single, x, result));
  EXPECT_LT(relative_difference(expected, result), 2e-6);
}

TEST(PMultigrid, IterationsDoNotGrowWithTheMesh)
{
  const std::string pmg =
      "-test_pc_type p_multigrid -test_pmg_levels_ksp_type richardson -test_pmg_levels_ksp_max_it 1 "
      "-test_pmg_levels_pc_type sor -test_pmg_coarse_ksp_type preonly -test_pmg_coarse_pc_type lu ";
  // springs on whole nodes, and a support that holds some components only
  for (const std::string &hold :
       {std::string(springs), std::string(" -support -support_surfaces x0,y0 -support_components_y0 y ")}) {
    const int coarse = iterations("cube_coarse.msh", hold + pmg), middle = iterations("cube.msh", hold + pmg),
              fine = iterations("cube_fine.msh", hold + pmg);
    EXPECT_LE(middle, 15) << hold;
    EXPECT_LE(fine, middle + 2) << hold << coarse;
    EXPECT_GT(iterations("cube_fine.msh", hold + "-test_pc_type jacobi"), 8 * fine);
  }
}

/// p-multigrid applied to a vector by the Jacobian at rest, in double (0) and single precision (1), and after the
/// matrix was doubled (2, 3).
PetscErrorCode precondition(const std::string &options, std::array<VecHandle, 4> &results)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  MatHandle A;
  VecHandle b;
  std::array<PC, 2> pcs;

  PetscFunctionBeginUser;
  PetscCall(prepare(run, cube("cube.msh") + options));
  PetscCall(jacobian_at_rest(run, A.out()));
  PetscCall(MatCreateVecs(A, nullptr, b.out()));
  PetscCall(VecSetRandom(b, nullptr));
  for (const bool single : {false, true}) {
    PC &pc = pcs[single];
    PetscCall(PCCreate(PETSC_COMM_WORLD, &pc));
    PetscCall(PCSetDM(pc, run.model().dm()));
    PetscCall(PCSetType(pc, "p_multigrid"));
    PetscCall(PCSetOptionsPrefix(pc, "test_"));
    PetscCall(PetscOptionsSetValue(nullptr, "-test_pmg_single", single ? "on" : "off"));
    PetscCall(PCSetFromOptions(pc));
  }
  for (std::size_t i = 0; i < results.size(); ++i) {
    if (i == 2) PetscCall(MatScale(A, 2));
    PetscCall(VecDuplicate(b, results[i].out()));
    PetscCall(PCSetOperators(pcs[i % 2], A, A));
    PetscCall(PCApply(pcs[i % 2], b, results[i]));
  }
  for (PC &pc : pcs) PetscCall(PCDestroy(&pc));
  PetscFunctionReturn(PETSC_SUCCESS);
}

TEST(PMultigrid, SinglePrecisionPreconditionsAsDouble)
{
  // Jacobi: Gauss-Seidel of AIJ takes other blocks, as rows of one pattern come (SingleBlocks tests it beside BAIJ).
  // Where nodes are held in part there are no whole blocks and nothing is single.
  const std::string pmg = " -test_pmg_levels_ksp_type richardson -test_pmg_levels_ksp_max_it 2 "
                          "-test_pmg_levels_pc_type jacobi -test_pmg_coarse_ksp_type preonly "
                          "-test_pmg_coarse_pc_type lu -test_pmg_coarse_pc_factor_mat_solver_type mumps ";
  for (const std::string &hold :
       {std::string(springs), std::string(" -support -support_surfaces x0,y0 -support_components_y0 y ")}) {
    std::array<VecHandle, 4> x;
    PULMO_OK(precondition(hold + pmg, x));
    const PetscReal difference = relative_difference(x[0], x[1]);
    EXPECT_LT(difference, 1e-5) << hold;
    if (hold == springs)
      EXPECT_GT(difference, 1e-10) << "nothing was rounded";
    else // on several ranks MUMPS adds in the order in which messages come
      EXPECT_LT(difference, 1e-13) << hold;
    PULMO_OK(VecScale(x[3], 2));
    EXPECT_LT(relative_difference(x[1], x[3]), 1e-5) << "after new values: " << hold;
  }
}

/// A lung with air in a deformed state: its Jacobian, that of P1 by cells and what the displacement's block is by
/// PETSc's own means.
struct Deformed {
  const Registry registry = Registry::standard();
  SceneRun run{registry};
  P1Matrix p1;
  MatHandle A, copy;
  DMHandle displacements;
  VecHandle x, x_t;
  IS rows = nullptr;
  bool fits = false;

  PetscErrorCode setup(const std::string &options)
  {
    const PetscInt field = displacement;
    PetscRandom random;

    PetscFunctionBeginUser;
    PetscCall(prepare(run, cube("cube.msh") +
                               "-airflow -airflow_surfaces x1 -lumen_pressure -lumen_pressure_surfaces x1 " + options));
    const DM dm = run.model().dm();
    rows = run.model().field_rows(displacement);
    PetscCall(DMCreateSubDM(dm, 1, &field, nullptr, displacements.out()));
    PetscCall(run.model().create_matrix(A.out()));
    PetscCall(run.model().set_step(0.05, 0.3));
    PetscCall(DMCreateLocalVector(dm, x.out()));
    PetscCall(VecDuplicate(x, x_t.out()));
    VecHandle global; // ranks see one state
    PetscCall(DMCreateGlobalVector(dm, global.out()));
    PetscCall(PetscRandomCreate(PETSC_COMM_WORLD, &random));
    PetscCall(PetscRandomSetInterval(random, -0.01, 0.01));
    PetscCall(VecSetRandom(global, random));
    PetscCall(PetscRandomDestroy(&random));
    PetscCall(DMGlobalToLocal(dm, global, INSERT_VALUES, x));
    PetscCall(p1.setup(dm, run.model().assembly(), fits));
    if (fits) run.model().also_fill(p1);
    PetscCall(assemble(false));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscErrorCode assemble(bool transposed)
  {
    PetscFunctionBeginUser;
    if (transposed)
      PetscCall(run.model().transposed_jacobian(0, x, x_t, 20, A));
    else
      PetscCall(run.model().jacobian(0, x, x_t, 20, A));
    PetscCall(MatCreateSubMatrix(A, rows, rows, MAT_INITIAL_MATRIX, copy.out()));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
};

TEST(P1Matrix, IsTheGalerkinMatrixOfTheDisplacement)
{
  for (const char *elements : {"P2-P1", "P1-P1", "P3-P2"})
    for (const std::string &hold : {std::string(springs), " -support -support_surfaces x0 " + std::string(springs)}) {
      SCOPED_TRACE(elements + hold);
      Deformed lung;
      PULMO_OK(lung.setup(hold + " -elements " + elements));
      ASSERT_TRUE(lung.fits);
      DMHandle space;
      MatHandle P;
      PULMO_OK(create_p1_space(lung.displacements, space.out()));
      PULMO_OK(create_p1_interpolation(lung.displacements, space, 3, P.out()));
      for (const bool transposed : {false, true}) {
        MatHandle product;
        PetscReal size, difference;
        PULMO_OK(lung.assemble(transposed));
        PULMO_OK(MatPtAP(lung.copy, P, MAT_INITIAL_MATRIX, 1, product.out()));
        PULMO_OK(MatNorm(product, NORM_INFINITY, &size));
        PULMO_OK(MatAXPY(product, -1, lung.p1.matrix(), DIFFERENT_NONZERO_PATTERN));
        PULMO_OK(MatNorm(product, NORM_INFINITY, &difference));
        EXPECT_LT(difference, 1e-13 * size) << (transposed ? "transposed" : "");
      }
    }
}

TEST(P1Matrix, DoesNotFitNodesThatAreHeldInPart)
{
  Deformed lung;
  PULMO_OK(lung.setup(" -support -support_surfaces x0,y0 -support_components_y0 y "));
  EXPECT_FALSE(lung.fits);
}

PetscErrorCode renew(const Deformed &lung, Mat block)
{
  return MatCreateSubMatrix(lung.A, lung.rows, lung.rows, MAT_REUSE_MATRIX, &block);
}

TEST(DisplacementBlock, StandsForACopy)
{
  Deformed lung;
  PULMO_OK(lung.setup(springs));
  MatHandle block, other, single, single_of_copy;
  DisplacementBlock *found = nullptr;
  VecHandle x, b, expected, result;
  const IS pressures = lung.run.model().field_rows(pressure);
  PULMO_OK(view_displacement(lung.A, lung.rows, lung.p1));
  PULMO_OK(MatCreateSubMatrix(lung.A, lung.rows, lung.rows, MAT_INITIAL_MATRIX, block.out()));
  PULMO_OK(DisplacementBlock::find(block, &found));
  ASSERT_NE(found, nullptr);
  EXPECT_EQ(found->whole, (Mat)lung.A);
  PULMO_OK(MatCreateSubMatrix(lung.A, lung.rows, pressures, MAT_INITIAL_MATRIX, other.out()));
  PULMO_OK(DisplacementBlock::find(other, &found));
  EXPECT_EQ(found, nullptr) << "all other blocks are copies";
  PULMO_OK(create_single_blocks(lung.A, lung.rows, single.out()));
  PULMO_OK(create_single_blocks(lung.copy, nullptr, single_of_copy.out()));
  PULMO_OK(MatCreateVecs(lung.copy, x.out(), b.out()));
  for (VecHandle *v : {&expected, &result}) PULMO_OK(VecDuplicate(x, v->out()));
  PULMO_OK(VecSetRandom(x, nullptr));
  PULMO_OK(VecSetRandom(b, nullptr));
  for (const double factor : {1., 3.}) {
    PetscObjectState before, after;
    PULMO_OK(PetscObjectStateGet((PetscObject)(Mat)block, &before));
    PULMO_OK(MatScale(lung.A, factor));
    PULMO_OK(MatScale(lung.copy, factor));
    PULMO_OK(renew(lung, block));
    PULMO_OK(PetscObjectStateGet((PetscObject)(Mat)block, &after));
    EXPECT_GT(after, before) << "who keeps what was made of it must see that it changed";
    PULMO_OK(update_single_blocks(single, lung.A));
    PULMO_OK(update_single_blocks(single_of_copy, lung.copy));
    PULMO_OK(MatMult(lung.copy, x, expected));
    PULMO_OK(MatMult(block, x, result));
    EXPECT_LT(relative_difference(expected, result), 1e-14);
    PULMO_OK(MatGetDiagonal(lung.copy, expected));
    PULMO_OK(MatGetDiagonal(block, result));
    EXPECT_EQ(relative_difference(expected, result), 0);
    // the same blocks in the same order, so the same numbers
    PULMO_OK(MatMult(single_of_copy, x, expected));
    PULMO_OK(MatMult(single, x, result));
    EXPECT_EQ(relative_difference(expected, result), 0);
    PULMO_OK(VecCopy(x, expected));
    PULMO_OK(VecCopy(x, result));
    PULMO_OK(MatSOR(single_of_copy, b, 1, SOR_LOCAL_SYMMETRIC_SWEEP, 0, 2, 1, expected));
    PULMO_OK(MatSOR(single, b, 1, SOR_LOCAL_SYMMETRIC_SWEEP, 0, 2, 1, result));
    EXPECT_EQ(relative_difference(expected, result), 0);
  }
}

TEST(PMultigrid, NeedsNoCopyOfItsBlock)
{
  Deformed lung;
  PULMO_OK(lung.setup(springs));
  const std::string options =
      " -test_pmg_single -test_pmg_levels_ksp_type richardson -test_pmg_levels_ksp_max_it 1 -test_pmg_levels_pc_type "
      "sor "
      "-test_pmg_coarse_ksp_type preonly -test_pmg_coarse_pc_type lu -test_pmg_coarse_pc_factor_mat_solver_type mumps ";
  PULMO_OK(PetscOptionsInsertString(nullptr, options.c_str()));
  MatHandle block;
  VecHandle b;
  std::array<VecHandle, 4> y; // copy, view; again with new values
  std::array<PC, 2> pcs;
  PULMO_OK(view_displacement(lung.A, lung.rows, lung.p1));
  PULMO_OK(MatCreateSubMatrix(lung.A, lung.rows, lung.rows, MAT_INITIAL_MATRIX, block.out()));
  PULMO_OK(MatCreateVecs(lung.copy, b.out(), nullptr));
  PULMO_OK(VecSetRandom(b, nullptr));
  for (std::size_t i = 0; i < y.size(); ++i) {
    PC &pc = pcs[i % 2];
    const Mat A = i % 2 ? (Mat)block : (Mat)lung.copy;
    if (i < 2) {
      PULMO_OK(PCCreate(PETSC_COMM_WORLD, &pc));
      PULMO_OK(PCSetDM(pc, lung.displacements));
      PULMO_OK(PCSetType(pc, "p_multigrid"));
      PULMO_OK(PCSetOptionsPrefix(pc, "test_"));
      PULMO_OK(PCSetFromOptions(pc));
    }
    if (i == 2) {
      PULMO_OK(lung.run.model().set_step(0.05, 1.5));
      PULMO_OK(VecScale(lung.x, -2));
      PULMO_OK(lung.run.model().jacobian(0, lung.x, lung.x_t, 20, lung.A));
      PULMO_OK(renew(lung, block));
      MatHandle other, values; // for a copy, which the matrix does not make any more
      PULMO_OK(lung.run.model().create_matrix(other.out()));
      PULMO_OK(lung.run.model().jacobian(0, lung.x, lung.x_t, 20, other));
      PULMO_OK(MatCreateSubMatrix(other, lung.rows, lung.rows, MAT_INITIAL_MATRIX, values.out()));
      PULMO_OK(MatCopy(values, lung.copy, SAME_NONZERO_PATTERN));
    }
    PULMO_OK(PCSetOperators(pc, A, A));
    PULMO_OK(VecDuplicate(b, y[i].out()));
    PULMO_OK(PCApply(pc, b, y[i]));
  }
  EXPECT_LT(relative_difference(y[0], y[1]), 1e-6);
  EXPECT_LT(relative_difference(y[2], y[3]), 1e-6);
  EXPECT_GT(relative_difference(y[0], y[2]), 1e-3) << "new values changed nothing";
  for (PC &pc : pcs) PULMO_OK(PCDestroy(&pc));
}

/// x' S x / x' S_exact x for several x, with the exact Schur complement on the pressure.
void expect_equivalent(const std::string &permeability, double low, double high)
{
  const Registry registry = Registry::standard();
  SceneRun run(registry);
  MatHandle A, A_uu, A_up, A_pu, A_pp, dense, rhs, solution, product, factor;
  PetscInt n, size;
  IS *splits;
  PULMO_OK(
      prepare(run, cube("cube.msh") + springs + "-airflow -airflow_surfaces x1 -airflow_permeability " + permeability));
  run.model().airway().hold(false);
  FixedStress schur;
  PULMO_OK(schur.setup(run.model().dm(), run.model().assembly()));
  run.model().also_fill(schur);
  PULMO_OK(jacobian_at_rest(run, A.out()));
  PULMO_OK(DMCreateFieldDecomposition(run.model().dm(), &n, nullptr, &splits, nullptr));
  PULMO_OK(MatCreateSubMatrix(A, splits[0], splits[0], MAT_INITIAL_MATRIX, A_uu.out()));
  PULMO_OK(MatCreateSubMatrix(A, splits[0], splits[1], MAT_INITIAL_MATRIX, A_up.out()));
  PULMO_OK(MatCreateSubMatrix(A, splits[1], splits[0], MAT_INITIAL_MATRIX, A_pu.out()));
  PULMO_OK(MatCreateSubMatrix(A, splits[1], splits[1], MAT_INITIAL_MATRIX, A_pp.out()));
  PULMO_OK(MatConvert(A_uu, MATDENSE, MAT_INITIAL_MATRIX, dense.out()));
  PULMO_OK(MatConvert(A_up, MATDENSE, MAT_INITIAL_MATRIX, rhs.out()));
  PULMO_OK(MatDuplicate(rhs, MAT_DO_NOT_COPY_VALUES, solution.out()));
  PULMO_OK(MatLUFactor(dense, nullptr, nullptr, nullptr));
  PULMO_OK(MatMatSolve(dense, rhs, solution));
  PULMO_OK(MatMatMult(A_pu, solution, MAT_INITIAL_MATRIX, PETSC_DEFAULT, product.out()));
  PULMO_OK(MatAYPX(product, -1, A_pp, DIFFERENT_NONZERO_PATTERN)); // A_pp - A_pu A_uu^-1 A_up
  PULMO_OK(MatGetSize(product, &size, nullptr));

  VecHandle x, y;
  PULMO_OK(MatCreateVecs(product, x.out(), y.out()));
  PetscRandom random;
  PULMO_OK(PetscRandomCreate(PETSC_COMM_WORLD, &random));
  for (PetscInt k = 0; k < 30; ++k) {
    PetscScalar exact, fixed;
    PULMO_OK(VecSet(x, k == 0));
    if (k > 20) {
      PULMO_OK(VecSetRandom(x, random));
    } else if (k > 0) {
      PULMO_OK(VecSetValue(x, k * 3 % size, 1, INSERT_VALUES));
    }
    PULMO_OK(MatMult(product, x, y));
    PULMO_OK(VecDot(x, y, &exact));
    PULMO_OK(MatMult(schur.matrix(), x, y));
    PULMO_OK(VecDot(x, y, &fixed));
    if (k ==
        0) { // a uniform pressure, no flow: K over what stands for it, (3 K + 2 M)/5; soft springs change it little
      const double M = 2 * (1 + 2 * 0.75 + 1), K = M - 2 * 4. / 3; // over the law's C at rest
      EXPECT_NEAR(fixed / exact, K / ((3 * K + 2 * M) / 5), 0.01) << permeability;
      continue;
    }
    EXPECT_GT(fixed / exact, low) << k;
    EXPECT_LT(fixed / exact, high) << k;
  }
  PULMO_OK(PetscRandomDestroy(&random));
  for (PetscInt i = 0; i < n; ++i) PULMO_OK(ISDestroy(&splits[i]));
  PULMO_OK(PetscFree(splits));
}

TEST(FixedStress, IsEquivalentToTheSchurComplement)
{
  expect_equivalent("1e4", 0.99, 1.01); // flow rules: the block itself
  expect_equivalent("1", 0.5, 3);
  expect_equivalent("1e-8", 0.5, 3); // storage rules
}

} // namespace
} // namespace pulmo::test
