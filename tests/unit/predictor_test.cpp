// What spares Newton work: the first guess of a step by least squares over past increments, and Jacobians that are
// kept.
#include "pulmo/solvers/lagging.hpp"
#include "pulmo/time/predictor.hpp"
#include "unit/scenes.hpp"

namespace pulmo::test {
namespace {

constexpr PetscInt size = 12;

/// F_i = (2 + i) x_i + x_(i+1) + cubic x_i^3 - load; not defined for x_0 > wall.
struct Problem {
  PetscReal cubic = 0, load = 1, wall = 1e9;
};

PetscErrorCode evaluate(SNES snes, Vec X, Vec F, void *context)
{
  const auto &problem = *static_cast<Problem *>(context);
  const ReadArray x(X);
  WriteArray f(F);

  PetscFunctionBeginUser;
  for (PetscInt i = 0; i < size; ++i)
    f[i] = (2 + i) * x[i] + (i + 1 < size ? x[i + 1] : 0) + problem.cubic * x[i] * x[i] * x[i] - problem.load;
  if (x[0] > problem.wall) PetscCall(SNESSetFunctionDomainError(snes));
  PetscFunctionReturn(PETSC_SUCCESS);
}

class PredictorTest : public ::testing::Test {
protected:
  void SetUp() override
  {
    PULMO_OK(VecCreateSeq(PETSC_COMM_SELF, size, x_.out()));
    PULMO_OK(VecDuplicate(x_, f_.out()));
    PULMO_OK(SNESDestroy(&snes_)); // of an earlier call
    PULMO_OK(SNESCreate(PETSC_COMM_SELF, &snes_));
    PULMO_OK(SNESSetFunction(snes_, f_, evaluate, &problem_));
    PULMO_OK(PetscOptionsSetValue(nullptr, "-predictor_increments", "2"));
    Options options(PETSC_COMM_SELF);
    PULMO_OK(predictor_.declare(options));
    PULMO_OK(PetscOptionsClearValue(nullptr, "-predictor_increments"));
    PULMO_OK(predictor_.setup(x_));
    // three states: zero, one increment along sin, one along cos
    PULMO_OK(VecZeroEntries(x_));
    PULMO_OK(predictor_.begin(x_));
    for (int step = 0; step < 2; ++step) {
      WriteArray x(x_);
      for (PetscInt i = 0; i < size; ++i) x[i] += direction(step, i);
      PULMO_OK(predictor_.accept(x_));
    }
  }
  void TearDown() override { PULMO_OK(SNESDestroy(&snes_)); }

  static PetscReal direction(int step, PetscInt i) { return 0.1 * (step ? std::cos(0.7 * i) : std::sin(1. + i)); }
  PetscErrorCode improve(PetscReal slope = 0, bool trusted = true)
  {
    return predictor_.improve(
        snes_, [](Vec) { return PetscErrorCode(0); }, slope, trusted, x_, norm_);
  }
  /// Solves the linear problem under @p load in place of the step that improve() began.
  void solve(PetscReal load)
  {
    WriteArray x(x_);
    for (PetscInt i = size; i-- > 0;) x[i] = (load - (i + 1 < size ? x[i + 1] : 0)) / (2 + i);
  }
  /// Steps under changing loads, each begun with @p slope; @p x: the guess of the last one. Returns its residuals.
  PetscInt guess_after_steps(const std::vector<PetscReal> &slopes, std::vector<PetscReal> &x)
  {
    PetscInt before, after;
    SetUp();
    for (std::size_t step = 0; step < slopes.size(); ++step) {
      problem_.load = 1 + 0.3 * static_cast<PetscReal>(step * step);
      EXPECT_EQ(static_cast<int>(SNESGetNumberFunctionEvals(snes_, &before)), 0);
      EXPECT_EQ(static_cast<int>(improve(slopes[step])), 0);
      EXPECT_EQ(static_cast<int>(SNESGetNumberFunctionEvals(snes_, &after)), 0);
      if (step + 1 == slopes.size()) break;
      solve(problem_.load);
      EXPECT_EQ(static_cast<int>(predictor_.accept(x_)), 0);
    }
    const ReadArray guess(x_);
    x.assign(guess.data(), guess.data() + size);
    return after - before;
  }
  PetscReal residual_norm()
  {
    PetscReal norm = -1;
    EXPECT_EQ(static_cast<int>(SNESComputeFunction(snes_, x_, f_)), 0);
    EXPECT_EQ(static_cast<int>(VecNorm(f_, NORM_2, &norm)), 0);
    return norm;
  }

  Problem problem_;
  SNES snes_ = nullptr;
  VecHandle x_, f_;
  Predictor predictor_;
  PetscReal norm_ = 0;
};

TEST_F(PredictorTest, LeavesTheStateAloneWhereItIsNotTrusted)
{
  VecHandle start;
  PetscBool same;
  PULMO_OK(VecDuplicate(x_, start.out()));
  PULMO_OK(VecCopy(x_, start));
  PetscInt before, after;
  PULMO_OK(SNESGetNumberFunctionEvals(snes_, &before));
  PULMO_OK(improve(0, false));
  PULMO_OK(SNESGetNumberFunctionEvals(snes_, &after));
  PULMO_OK(VecEqual(x_, start, &same));
  EXPECT_TRUE(same);
  EXPECT_EQ(after, before + 1) << "the residual at the start is what tolerances are relative to";
  PULMO_OK(improve());
  PULMO_OK(VecEqual(x_, start, &same));
  EXPECT_FALSE(same) << "the scene has nothing to guess";
}

TEST_F(PredictorTest, MinimisesTheResidualOverPastIncrements)
{
  const PetscReal before = residual_norm();
  PULMO_OK(improve());
  EXPECT_DOUBLE_EQ(norm_, before);
  EXPECT_LT(residual_norm(), before);
  // the normal equations of the linear problem: F is orthogonal to A d for each past increment d
  const ReadArray f(f_);
  for (int step = 0; step < 2; ++step) {
    PetscReal dot = 0;
    for (PetscInt i = 0; i < size; ++i)
      dot += f[i] * ((2 + i) * direction(step, i) + (i + 1 < size ? direction(step, i + 1) : 0));
    EXPECT_NEAR(dot, 0, 1e-12) << "increment " << step;
  }
}

TEST_F(PredictorTest, StepsOfTheSameLengthLeaveTheirSecantsBehind)
{
  std::vector<PetscReal> evaluated, left, longer;
  // without slopes: the residual at the start, of two secants, of the guess
  EXPECT_EQ(guess_after_steps({0, 0, 0}, evaluated), 4);
  EXPECT_EQ(guess_after_steps({20, 20, 20}, left), 2);
  EXPECT_EQ(guess_after_steps({20, 20, 10}, longer), 4) << "secants of steps of another length are of no use";
  for (std::size_t i = 0; i < evaluated.size(); ++i) {
    EXPECT_NEAR(left[i], evaluated[i], 1e-12); // a linear problem has the same secants everywhere
    EXPECT_NEAR(longer[i], evaluated[i], 1e-12);
  }
}

TEST_F(PredictorTest, KeepsTheLastStateWhereTheGuessIsWorse)
{
  VecHandle start;
  PetscBool same;
  // secants of a steep cubic foresee nothing of what lies between
  problem_.cubic = 1e6;
  problem_.load = -1e5;
  PULMO_OK(VecDuplicate(x_, start.out()));
  PULMO_OK(VecCopy(x_, start));
  const PetscReal before = residual_norm();
  PULMO_OK(improve());
  PULMO_OK(VecEqual(x_, start, &same));
  EXPECT_TRUE(same);
  EXPECT_DOUBLE_EQ(norm_, before);
}

TEST_F(PredictorTest, HandsTheResidualOfItsGuessOn)
{
  Vec handed;
  VecHandle copy;
  PetscBool same;
  PULMO_OK(improve());
  PULMO_OK(SNESGetFunction(snes_, &handed, nullptr, nullptr));
  PULMO_OK(VecDuplicate(handed, copy.out()));
  PULMO_OK(VecCopy(handed, copy));
  residual_norm(); // leaves the residual of x_ in f_
  PULMO_OK(VecEqual(copy, f_, &same));
  EXPECT_TRUE(same);
}

TEST_F(PredictorTest, LeavesOutAnIncrementThatLeadsWhereTheResidualIsNotDefined)
{
  // the first entries of the increments are 0.084 (the older one) and 0.1
  problem_.wall = ReadArray(x_)[0] + 0.09;
  const PetscReal before = residual_norm();
  PULMO_OK(improve());
  EXPECT_LT(residual_norm(), before);
  // along the older increment alone
  const ReadArray f(f_);
  PetscReal dot = 0;
  for (PetscInt i = 0; i < size; ++i)
    dot += f[i] * ((2 + i) * direction(0, i) + (i + 1 < size ? direction(0, i + 1) : 0));
  EXPECT_NEAR(dot, 0, 1e-12);
}

TEST_F(PredictorTest, LeavesAStartAloneWhereTheResidualIsNotDefined)
{
  PetscBool same;
  VecHandle start;
  PULMO_OK(VecDuplicate(x_, start.out()));
  PULMO_OK(VecCopy(x_, start));
  problem_.wall = ReadArray(x_)[0] - 1e-9;
  PULMO_OK(improve());
  PULMO_OK(VecEqual(x_, start, &same));
  EXPECT_TRUE(same);
  EXPECT_FALSE(std::isfinite(norm_));
}

/// x^2 = load for each entry, with a diagonal Jacobian that counts how often it was made.
struct Square {
  PetscReal load = 1;
  int jacobians = 0;
};

PetscErrorCode evaluate_square(SNES, Vec X, Vec F, void *context)
{
  PetscFunctionBeginUser;
  PetscCall(VecPointwiseMult(F, X, X));
  PetscCall(VecShift(F, -static_cast<Square *>(context)->load));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode differentiate_square(SNES, Vec X, Mat A, Mat, void *context)
{
  PetscFunctionBeginUser;
  ++static_cast<Square *>(context)->jacobians;
  PetscCall(MatDiagonalSet(A, X, INSERT_VALUES));
  PetscCall(MatScale(A, 2));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode judge(SNES snes, PetscInt it, PetscReal x, PetscReal y, PetscReal f, SNESConvergedReason *reason,
                     void *lagging)
{
  PetscFunctionBeginUser;
  PetscCall(SNESConvergedDefault(snes, it, x, y, f, reason, nullptr));
  static_cast<Lagging *>(lagging)->judge(snes, it, f);
  PetscFunctionReturn(PETSC_SUCCESS);
}

class LaggingTest : public ::testing::Test {
protected:
  void make(const std::string &options)
  {
    KSP ksp;
    PC pc;
    PULMO_OK(set_options(options));
    PULMO_OK(MatCreateSeqAIJ(PETSC_COMM_SELF, 3, 3, 1, nullptr, A_.out()));
    for (PetscInt i = 0; i < 3; ++i) PULMO_OK(MatSetValue(A_, i, i, 1, INSERT_VALUES));
    PULMO_OK(MatAssemblyBegin(A_, MAT_FINAL_ASSEMBLY));
    PULMO_OK(MatAssemblyEnd(A_, MAT_FINAL_ASSEMBLY));
    PULMO_OK(MatCreateVecs(A_, x_.out(), nullptr));
    PULMO_OK(SNESDestroy(&snes_)); // of an earlier call
    PULMO_OK(SNESCreate(PETSC_COMM_SELF, &snes_));
    PULMO_OK(SNESSetFunction(snes_, nullptr, evaluate_square, &square_));
    PULMO_OK(SNESSetJacobian(snes_, A_, A_, differentiate_square, &square_));
    PULMO_OK(SNESSetTolerances(snes_, 1e-10, 0, 0, 100, 10000));
    PULMO_OK(SNESGetKSP(snes_, &ksp));
    PULMO_OK(KSPSetType(ksp, KSPPREONLY));
    PULMO_OK(KSPGetPC(ksp, &pc));
    PULMO_OK(PCSetType(pc, PCLU));
    PULMO_OK(SNESSetFromOptions(snes_));
    Options declared(PETSC_COMM_SELF);
    PULMO_OK(lagging_.declare(declared));
    PULMO_OK(lagging_.setup(snes_));
    PULMO_OK(SNESSetConvergenceTest(snes_, judge, &lagging_, nullptr));
    PULMO_OK(VecSet(x_, 1));
  }
  void TearDown() override { PULMO_OK(SNESDestroy(&snes_)); }

  /// Newton steps to the root of @p load from the last one, and Jacobians made on the way.
  std::array<int, 2> solve(PetscReal load)
  {
    PetscInt n = -1;
    const int before = square_.jacobians;
    square_.load = load;
    EXPECT_EQ(static_cast<int>(SNESSolve(snes_, nullptr, x_)), 0);
    EXPECT_EQ(static_cast<int>(SNESGetIterationNumber(snes_, &n)), 0);
    const ReadArray x(x_);
    EXPECT_NEAR(x[0], std::sqrt(load), 1e-9 * std::sqrt(load));
    return {static_cast<int>(n), square_.jacobians - before};
  }

  Square square_;
  SNES snes_ = nullptr;
  MatHandle A_;
  VecHandle x_;
  Lagging lagging_;
};

constexpr const char *lag = "-snes_lag_jacobian 1000 -snes_lag_preconditioner 1000 ";
constexpr const char *persists = "-snes_lag_jacobian_persists -snes_lag_preconditioner_persists ";

TEST_F(LaggingTest, AJacobianThatServesIsKeptOverSolves)
{
  make(std::string(lag) + persists + "-newton_refresh 0.2");
  EXPECT_EQ(solve(1.01)[1], 1);
  EXPECT_EQ(solve(1.02)[1], 0);
}

TEST_F(LaggingTest, AJacobianThatLeavesTooMuchIsRenewed)
{
  make(std::string(lag) + persists + "-newton_refresh 0.2");
  solve(1.01);
  const auto [steps, jacobians] = solve(25);
  EXPECT_GE(jacobians, 1);
  make(std::string(lag) + persists + "-newton_refresh 1e9");
  solve(1.01);
  EXPECT_EQ(solve(1.2)[1], 0);
  EXPECT_LT(steps, 20); // the kept one alone diverges
}

TEST_F(LaggingTest, WithoutPersistsEachSolveBeginsWithANewOne)
{
  make(std::string(lag) + "-newton_refresh 0.2");
  solve(25); // renewed on the way: the count must not reach into the next solve
  EXPECT_EQ(solve(25.1)[1], 1);
}

TEST_F(LaggingTest, AFailedStepIsRetriedOnceWithNothingOld)
{
  bool again = false;
  make(std::string(lag) + persists);
  solve(1.01);
  PULMO_OK(lagging_.retry(snes_, again));
  EXPECT_TRUE(again);
  const auto [steps, jacobians] = solve(1.5);
  EXPECT_EQ(steps, jacobians);
  PULMO_OK(lagging_.retry(snes_, again));
  EXPECT_FALSE(again);
  PULMO_OK(lagging_.settle(snes_));
  EXPECT_EQ(solve(1.51)[1], 0);
}

TEST_F(LaggingTest, WhereNothingLagsAFailedStepIsNotRetried)
{
  bool again = true;
  make("");
  PULMO_OK(lagging_.retry(snes_, again));
  EXPECT_FALSE(again);
}

} // namespace
} // namespace pulmo::test
