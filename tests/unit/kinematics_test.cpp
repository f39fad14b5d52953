// Kinematics of a point against long double arithmetic and numerical derivatives.
#include "unit/tensors.hpp"

namespace pulmo::test {
namespace {

/// det(I + H) - 1 in long double.
double exact_J_minus_1(const Tensor &H)
{
  long double F[9];
  for (int i = 0; i < 9; ++i) F[i] = static_cast<long double>(H[i]) + (i % 4 == 0 ? 1 : 0);
  return static_cast<double>(det(F) - 1);
}

TEST(Kinematics, JMinusOneKeepsItsDigitsNearTheReferenceState)
{
  Random random(1);
  for (double size : {1e-1, 1e-3, 1e-5, 1e-6}) {
    for (int i = 0; i < 100; ++i) {
      const Tensor H = random.tensor(size);
      // long double itself loses digits: its epsilon is 1.1e-19
      EXPECT_NEAR(jacobian_minus_one(H.data()), exact_J_minus_1(H), 1e-15 * size + 4e-19) << size;
    }
  }
  // exactly representable: (1 + a)(1 + b)(1 + c) - 1 with powers of two, shear that does not change J
  const double a = std::ldexp(1, -40), b = std::ldexp(1, -41), c = std::ldexp(1, -39);
  const Tensor H{a, 0.75, -0.5, 0, b, 3, 0, 0, c};
  EXPECT_DOUBLE_EQ(jacobian_minus_one(H.data()), a + b + c + (a * b + b * c + a * c) + a * b * c);
  // isochoric shear: exactly zero
  const Tensor shear{0, 0.3, 0.7, 0, 0, -0.9, 0, 0, 0};
  EXPECT_EQ(jacobian_minus_one(shear.data()), 0);
}

TEST(Kinematics, CofactorIsDetTimesInverseTransposed)
{
  Random random(2);
  for (int i = 0; i < 200; ++i) {
    const Tensor F = random_deformation(random, random(0.1, 5));
    Tensor cof;
    cofactor(F.data(), cof.data());
    const Tensor expected = det(F) * transposed(inverse(F));
    EXPECT_LT(largest(cof - expected), 1e-13 * largest(expected));
    EXPECT_NEAR(determinant(F.data()), det(F), 1e-14 * std::pow(largest(F), 3));
  }
  // a singular tensor has a cofactor, too
  const Tensor singular{1, 2, 3, 2, 4, 6, 1, 0, 1};
  Tensor cof;
  cofactor(singular.data(), cof.data());
  EXPECT_EQ(cof, (Tensor{4, 4, -4, -2, -2, 2, 0, 0, 0}));
}

TEST(Kinematics, TensorCrossIsTheBilinearFormOfTheCofactor)
{
  Random random(3);
  for (int i = 0; i < 50; ++i) {
    const Tensor A = random.tensor(2), B = random.tensor(2), sum = A + B;
    Tensor cof_sum, cof_A, cof_B, cross, AxA;
    cofactor(sum.data(), cof_sum.data());
    cofactor(A.data(), cof_A.data());
    cofactor(B.data(), cof_B.data());
    tensor_cross(A.data(), B.data(), cross.data());
    tensor_cross(A.data(), A.data(), AxA.data());
    EXPECT_LT(largest(cof_sum - cof_A - cross - cof_B), 1e-13);
    EXPECT_LT(largest(AxA - 2.0 * cof_A), 1e-14 * 16);
    EXPECT_NEAR(contract(A.data(), B.data()), dot(A, B), 1e-14 * 16);
  }
}

TEST(Kinematics, CofactorDerivativeAgreesWithDifferences)
{
  Random random(4);
  for (int n = 0; n < 20; ++n) {
    const Tensor F = random_deformation(random, random(0.3, 3));
    const double factor = random(-2, 2);
    double g3[81];
    for (double &g : g3) g = 0.25; // what is there stays
    add_cofactor_derivative(F.data(), factor, g3);
    for (int k = 0; k < 3; ++k)
      for (int L = 0; L < 3; ++L) {
        Tensor up = F, down = F, cof_up, cof_down; // the cofactor is quadratic: central differences are exact
        up[3 * k + L] += 0.5;
        down[3 * k + L] -= 0.5;
        cofactor(up.data(), cof_up.data());
        cofactor(down.data(), cof_down.data());
        for (int i = 0; i < 3; ++i)
          for (int J = 0; J < 3; ++J)
            EXPECT_NEAR(g3[27 * i + 9 * k + 3 * J + L] - 0.25, factor * (cof_up[3 * i + J] - cof_down[3 * i + J]),
                        1e-14 * 20);
      }
  }
}

TEST(Kinematics, PointStateHoldsTheSameDeformationThroughout)
{
  Random random(5);
  const Tensor F = random_deformation(random, 1.7), rate = random.tensor(3);
  const PointState s = state_of_F(F, rate);
  for (int i = 0; i < 9; ++i) {
    EXPECT_NEAR(s.F[i], F[i], 1e-15 * 4);
    EXPECT_EQ(s.H_rate[i], rate[i]);
    EXPECT_NEAR(s.H[i], F[i] - identity[i], 1e-15 * 4);
    EXPECT_NEAR(s.cof_F[i], det(F) * transposed(inverse(F))[i], 1e-13);
  }
  EXPECT_NEAR(s.J, 1.7, 1e-13);
  EXPECT_NEAR(s.J_minus_1, 0.7, 1e-13);

  PointState still;
  make_point_state(s.H, nullptr, still);
  for (double r : still.H_rate) EXPECT_EQ(r, 0);
}

} // namespace
} // namespace pulmo::test
