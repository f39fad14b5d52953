// The first guess of a step: least squares over past increments, dropped where it does not help.
#include "pulmo/predictor.hpp"
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
  PetscErrorCode improve()
  {
    return predictor_.improve(
        snes_, [](Vec) { return PetscErrorCode(0); }, x_, norm_);
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
  EXPECT_TRUE(same || residual_norm() < before);
  EXPECT_LE(residual_norm(), before);
}

TEST_F(PredictorTest, LeavesOutIncrementsThatLeadWhereTheResidualIsNotDefined)
{
  PetscBool same;
  VecHandle start;
  PULMO_OK(VecDuplicate(x_, start.out()));
  PULMO_OK(VecCopy(x_, start));
  problem_.wall = ReadArray(x_)[0] + 1e-9; // both increments have a positive first entry
  PULMO_OK(improve());
  PULMO_OK(VecEqual(x_, start, &same));
  EXPECT_TRUE(same);
}

} // namespace
} // namespace pulmo::test
