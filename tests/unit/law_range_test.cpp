// The range of tissue laws, against closed forms.
#include "pulmo/physics/law_range.hpp"
#include "pulmo/physics/registry.hpp"
#include "pulmo/physics/tissue/berger.hpp"
#include "pulmo/physics/tissue/yoshihara.hpp"
#include "unit/tensors.hpp"

namespace pulmo::test {
namespace {

/// W = mu/2 (I1 - 3 - 2 ln J) + kappa/2 (J - 1)^2.
struct Simple {
  static constexpr const char *name = "simple", *alias = "", *source = "test";
  static constexpr bool uses_I2 = false;
  struct Parameters {
    static constexpr const char *owner = "tissue";
    PetscScalar mu = 1, kappa = 0.05;
  };
  static PetscErrorCode declare(Options &, Parameters &) { return PETSC_SUCCESS; }
  template <class T>
  static T W(const Invariants<T> &inv, const Parameters &k)
  {
    return k.mu / 2 * (inv.I1_minus_3 - 2 * inv.log_J()) + k.kappa / 2 * inv.J_minus_1 * inv.J_minus_1;
  }
};

std::unique_ptr<TissueLaw> law(const std::string &name)
{
  for (auto &l : Registry::standard().make_tissue_laws())
    if (l->name() == name) return std::move(l);
  return nullptr;
}

TEST(LawRange, SimpleLawInClosedForm)
{
  // p = mu (J^(-1/3) - 1/J) + kappa (J - 1), p' = mu (1/J^2 - J^(-4/3)/3) + kappa, p'' = mu (4/9 J^(-7/3) - 2/J^3) = 0
  const Simple::Parameters k;
  const TissueLawOf<Simple> simple(k);
  const LawRange range = law_range(simple);
  const double softest = std::pow(4.5, 1.5);
  const auto slope = [&](double J) { return k.mu * (1 / (J * J) - std::pow(J, -4. / 3) / 3) + k.kappa; };
  ASSERT_TRUE(range.softest);
  EXPECT_NEAR(range.softest->J, softest, 1e-3);
  EXPECT_NEAR(range.softest_share, slope(softest) / slope(1), 1e-8);
  EXPECT_NEAR(range.softest->pressure, k.mu * (std::pow(softest, -1. / 3) - 1 / softest) + k.kappa * (softest - 1),
              1e-4);
  EXPECT_FALSE(range.largest || range.least || range.waves_above || range.waves_below);
  // with less bulk stiffness p' is zero before
  const Simple::Parameters soft{1, 0.002};
  const LawRange limited = law_range(TissueLawOf<Simple>(soft));
  const double limit = root([&](double J) { return std::pow(J, -4. / 3) / 3 - 1 / (J * J) - soft.kappa; }, 2, 9);
  ASSERT_TRUE(limited.largest);
  EXPECT_NEAR(limited.largest->J, limit, 1e-10);
  EXPECT_FALSE(limited.softest);
}

TEST(LawRange, YoshiharasLimitPoint)
{
  // p = 2 c (J^(-1/3) - J^(-2 beta - 1)): p' = 0 where J^(2 beta + 2/3) = 3 (2 beta + 1)
  for (double beta : {0.75, 1.2}) {
    const double c = 1.298, J = std::pow(3 * (2 * beta + 1), 1 / (2 * beta + 2. / 3));
    const TissueLawOf<Yoshihara> l({c, beta});
    const LawRange range = law_range(l);
    ASSERT_TRUE(range.largest);
    EXPECT_NEAR(range.largest->J, J, 1e-10);
    EXPECT_NEAR(range.largest->pressure, 2 * c * (std::pow(J, -1. / 3) - std::pow(J, -2 * beta - 1)), 1e-13);
    EXPECT_FALSE(inflated_J(l, range.largest->pressure * (1 + 1e-9)));
    ASSERT_TRUE(inflated_J(l, range.largest->pressure * (1 - 1e-9)));
    EXPECT_LT(*inflated_J(l, range.largest->pressure * (1 - 1e-9)), J);
    EXPECT_FALSE(range.least || range.waves_above || range.waves_below);
  }
}

TEST(LawRange, MaLosesShearInCompression)
{
  // d2W/ds2 along a shear of F = s I: J of isotropic compression = (S / (S + 2 G))^(3/2), S = 2 (3 a + b), G = -b / 2
  const double a = 0.43, b = -0.6, S = 2 * (3 * a + b), G = -b / 2;
  const LawRange range = law_range(*law("ma"));
  ASSERT_TRUE(range.waves_below);
  EXPECT_NEAR(range.waves_below->J, std::pow(S / (S + 2 * G), 1.5), 1e-6);
  EXPECT_FALSE(range.waves_above || range.largest);
}

TEST(LawRange, PressuresAndVolumesAreThoseOfTheClosedForms)
{
  for (const auto &l : Registry::standard().make_tissue_laws()) {
    const LawRange range = law_range(*l);
    for (double J : {0.7, 0.95, 1.0, 1.1, 1.8, 2.4}) {
      const auto p = test::inflation_pressure(l->name(), J);
      if (!p) continue;
      EXPECT_NEAR(pulmo::inflation_pressure(*l, J), *p, 1e-13 * (1 + std::abs(*p))) << l->name() << " " << J;
      if (range.largest && J > range.largest->J) continue;
      const auto found = inflated_J(*l, *p);
      ASSERT_TRUE(found) << l->name() << " " << J;
      EXPECT_NEAR(*found, J, 1e-9) << l->name();
    }
  }
}

TEST(LawRange, ABarrierEndsNothing)
{
  Berger::Parameters k;
  k.phi0 = 0.5; // none below J = 0.5, where the derivatives of W are numbers again
  const TissueLawOf<Berger> l(k);
  const LawRange range = law_range(l);
  EXPECT_FALSE(range.least || range.waves_below);
  for (double p : {-1.0, -100.0, -1e5}) {
    const auto J = inflated_J(l, p);
    ASSERT_TRUE(J) << p;
    EXPECT_GT(*J, 0.5);
    EXPECT_NEAR(pulmo::inflation_pressure(l, *J), p, 1e-6 * std::abs(p));
  }
}

} // namespace
} // namespace pulmo::test
