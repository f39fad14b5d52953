// Kernels of the effects at one point: closed forms, and every Jacobian kernel against its residual kernel.
#include "unit/tensors.hpp"

#include "pulmo/physics/effects/airflow.hpp"
#include "pulmo/physics/effects/chest_wall.hpp"
#include "pulmo/physics/effects/gravity.hpp"
#include "pulmo/physics/effects/lumen_pressure.hpp"
#include "pulmo/physics/effects/traction.hpp"
#include "pulmo/physics/effects/ventilator.hpp"
#include "pulmo/physics/permeability/constant.hpp"
#include "pulmo/physics/permeability/exponential.hpp"
#include "pulmo/physics/permeability/holmes_mow.hpp"
#include "pulmo/physics/permeability/kozeny_carman.hpp"
#include "pulmo/physics/permeability/power.hpp"

namespace pulmo::test {
namespace {

/// k(J) = k0 J^m + k1 J: a law whose derivative does not vanish.
struct TestPermeability {
  struct Parameters {
    [[maybe_unused]] static constexpr const char *owner = "permeability";
    PetscScalar k0 = 0.8, m = 2.5, k1 = 0.3;
  };
  static PermeabilityValue permeability(PetscScalar J, const Parameters &p)
  {
    return {p.k0 * std::pow(J, p.m) + p.k1 * J, p.k0 * p.m * std::pow(J, p.m - 1) + p.k1};
  }
};

/// Everything that a kernel may read, as values that differences can change one by one.
struct Data {
  Tensor H{}, rate{};
  double u[3]{}, p = 0, grad_p[3]{}, x[3]{}, normal[3]{0, 0, 1};
  Step step{0.05, 0.4};
  double shift = 0;
  bool airflow = true;

  explicit Data(Random &random, double J)
  {
    H = random_deformation(random, J) - identity;
    rate = random.tensor(4);
    p = random(-0.3, 1);
    for (int d = 0; d < 3; ++d) {
      u[d] = random();
      grad_p[d] = random();
      normal[d] = random(0.1, 1);
    }
    const double length = std::sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]);
    for (double &n : normal) n /= length;
    shift = random(1, 40);
  }
  Tensor F() const { return H + identity; }
  Tensor cof() const { return det(F()) * transposed(inverse(F())); }

  template <class P>
  std::vector<double> call(Kernel<P> kernel, const P &parameters, std::size_t size) const
  {
    PointState s;
    make_point_state(H.data(), rate.data(), s);
    std::vector<double> out(size, 0.125); // kernels add
    kernel({s, u, p, airflow ? grad_p : nullptr, 0.2, shift, x, normal, step}, parameters, out.data());
    for (double &o : out) o -= 0.125;
    return out;
  }
};

/// Checks tangent[index(c, k, ...)] = d residual_c / d variable_k for one set of variables; @p change moves variable
/// k by a step. @p place tells where the derivative of component c by variable k is stored.
template <class P>
void expect_derivative(const Data &data, Kernel<P> residual, Kernel<P> tangent, const P &parameters, int components,
                       int variables, const std::function<void(Data &, int, double)> &change,
                       const std::function<int(int, int)> &place)
{
  const auto A = data.call(tangent, parameters, static_cast<std::size_t>(components * variables));
  double scale = 0;
  for (double a : A) scale = std::max(scale, std::abs(a));
  ASSERT_GT(scale, 0);
  for (int c = 0; c < components; ++c)
    for (int k = 0; k < variables; ++k) {
      const double expected = derivative(
          [&](double step) {
            Data moved = data;
            change(moved, k, step);
            return moved.call(residual, parameters, static_cast<std::size_t>(components))[c];
          },
          3e-4);
      EXPECT_NEAR(A[place(c, k)], expected, 2e-10 * scale) << "component " << c << " by variable " << k;
    }
}

/// Moves H, and with it the rate, as an implicit step does.
void move_H(Data &d, int k, double step)
{
  d.H[k] += step;
  d.rate[k] += d.shift * step;
}
void move_p(Data &d, int, double step)
{
  d.p += step;
}
void move_grad_p(Data &d, int k, double step)
{
  d.grad_p[k] += step;
}
void move_u(Data &d, int k, double step)
{
  d.u[k] += step;
}

/// g3 of (vector, vector): [i][k][J][L] for residual component 3 i + J and variable 3 k + L.
int vector_by_vector(int c, int v)
{
  return 27 * (c / 3) + 9 * (v / 3) + 3 * (c % 3) + v % 3;
}
/// g3 of (scalar, vector): [k][I][L].
int scalar_by_vector(int I, int v)
{
  return 9 * (v / 3) + 3 * I + v % 3;
}
/// g1 of (vector, vector): [i][k][L], and everything else that is stored [component][variable].
int nine(int c, int v)
{
  return 9 * c + v;
}
int three(int c, int v)
{
  return 3 * c + v;
}
int one(int c, int)
{
  return c;
}

template <class Check>
void at_points(Check check)
{
  Random random(41);
  for (double J : {0.3, 0.8, 1.0, 1.6, 3.0})
    for (int i = 0; i < 4; ++i) {
      SCOPED_TRACE("J = " + std::to_string(J));
      check(Data(random, J));
    }
}

constexpr NoParameters none;

TEST(Airflow, GasStressIsMinusPressureTimesCofactor)
{
  at_points([](const Data &d) {
    const auto f1 = d.call<NoParameters>(AirflowKernels::gas_stress, none, 9);
    for (int i = 0; i < 9; ++i) EXPECT_NEAR(f1[i], -d.p * d.cof()[i], 1e-13 * 10);
    expect_derivative<NoParameters>(d, AirflowKernels::gas_stress, AirflowKernels::gas_stress_by_displacement, none, 9,
                                    9, move_H, vector_by_vector);
    expect_derivative<NoParameters>(d, AirflowKernels::gas_stress, AirflowKernels::gas_stress_by_pressure, none, 9, 1,
                                    move_p, one);
  });
}

TEST(Airflow, PorosityRateIsTheExactDifferenceQuotient)
{
  at_points([](Data d) {
    for (double dt : {0.5, 0.05, 1e-3, 1e-7}) {
      d.step.dt = dt;
      const double rate_size = 0.3 / std::max(dt, 0.05); // keeps the state before the step moderate
      d.rate = (rate_size / 4) * d.rate;
      long double now[9], before[9];
      for (int i = 0; i < 9; ++i) {
        now[i] = static_cast<long double>(d.H[i]) + identity[i];
        before[i] = now[i] - static_cast<long double>(dt) * d.rate[i];
      }
      const auto expected = static_cast<double>((det(now) - det(before)) / dt);
      // for tiny steps even long double cancels
      EXPECT_NEAR(d.call<NoParameters>(AirflowKernels::porosity_rate, none, 1)[0], expected,
                  1e-13 * (1 + std::abs(rate_size)) + 4e-18 / dt);
    }
  });
}

TEST(Airflow, PorosityRateDerivativeForAnyShift)
{
  at_points([](Data d) {
    for (double shift : {1 / d.step.dt, 7.0, 0.0, 55.0}) {
      d.shift = shift;
      expect_derivative<NoParameters>(d, AirflowKernels::porosity_rate, AirflowKernels::porosity_rate_by_displacement,
                                      none, 1, 9, move_H, nine);
    }
  });
}

template <class Law>
void expect_darcy(const Data &d, const PermeabilityParameters<Law> &k)
{
  using K = DarcyKernels<Law>;
  using P = PermeabilityParameters<Law>;
  // -Q = k J F^-1 F^-T Grad p
  const Tensor inverse_F = inverse(d.F()), inverse_C = inverse_F * transposed(inverse_F);
  const double J = det(d.F());
  const auto flux = d.call<P>(K::flux, k, 3);
  for (int I = 0; I < 3; ++I) {
    double expected = 0;
    for (int L = 0; L < 3; ++L) expected += permeability_of<Law>(J, k).k * J * inverse_C[3 * I + L] * d.grad_p[L];
    EXPECT_NEAR(flux[I], expected, 1e-12 * (1 + std::abs(expected)));
  }
  expect_derivative<P>(d, K::flux, K::flux_by_pressure, k, 3, 3, move_grad_p, three);
  expect_derivative<P>(d, K::flux, K::flux_by_displacement, k, 3, 9, move_H, scalar_by_vector);
}

TEST(Airflow, DarcyFluxWithConstantPermeability)
{
  ConstantPermeability::Parameters k;
  k.k = 0.7;
  at_points([&](const Data &d) { expect_darcy<ConstantPermeability>(d, k); });
}

TEST(Airflow, DarcyFluxWithPermeabilityThatFollowsJ)
{
  at_points([](const Data &d) { expect_darcy<TestPermeability>(d, {}); });
}

TEST(Airflow, DarcyFluxWithEachLawOfThePorosity)
{
  at_points([](const Data &d) {
    const Porosity porosity{0.83}; // below all J of at_points()
    expect_darcy<PowerPermeability>(d, {{0.7, 1.7}, porosity});
    expect_darcy<KozenyCarmanPermeability>(d, {{0.7}, porosity});
    expect_darcy<HolmesMowPermeability>(d, {{0.7, 1.3, 0.6}, porosity});
    expect_darcy<ExponentialPermeability>(d, {{0.7, 0.9}, porosity});
  });
}

/// dk/dJ of a law at J, against differences.
template <class Law>
void expect_slope(double J, const PermeabilityParameters<Law> &p)
{
  const PermeabilityValue v = permeability_of<Law>(J, p);
  const double slope = derivative([&](double step) { return permeability_of<Law>(J + step, p).k; }, 1e-4);
  EXPECT_NEAR(v.dk_dJ, slope, 1e-9 * (std::abs(v.dk_dJ) + v.k)) << Law::name << ", J = " << J;
}

TEST(Permeability, LawsArePublishedFormulas)
{
  // Phi0 = 0.6, J = 1.5, so that a = 1.1/0.6
  const Porosity porosity{0.6};
  EXPECT_NEAR((permeability_of<PowerPermeability>(1.5, {{2, 2. / 3}, porosity}).k), 2.9958791, 1e-7);
  EXPECT_NEAR((permeability_of<KozenyCarmanPermeability>(1.5, {{2}, porosity}).k), 8.2160494, 1e-7);
  EXPECT_NEAR((permeability_of<HolmesMowPermeability>(1.5, {{2, 2, 0.4}, porosity}).k), 8.6315042, 1e-7);
  EXPECT_NEAR((permeability_of<ExponentialPermeability>(1.5, {{2, 0.3}, porosity}).k), 2.5680508, 1e-7);
  for (double J : {0.45, 0.9, 1.0, 1.7, 3.0}) {
    expect_slope<PowerPermeability>(J, {{2, 2. / 3}, porosity});
    expect_slope<KozenyCarmanPermeability>(J, {{2}, porosity});
    expect_slope<HolmesMowPermeability>(J, {{2, 2, 0.4}, porosity});
    expect_slope<ExponentialPermeability>(J, {{2, 0.3}, porosity});
  }
}

/// phi^3 / (1 - phi)^2 of the Eulerian porosity, over its value at rest.
TEST(Permeability, KozenyCarmanIsThatOfTheEulerianPorosity)
{
  for (double Phi0 : {0.3, 0.75, 0.99}) {
    const auto packed = [](double phi) { return phi * phi * phi / ((1 - phi) * (1 - phi)); };
    for (double J : {0.8, 1.0, 1.009, 1.01, 1.011, 2.0, 5.0}) { // with Phi0 = 0.99 the Lagrangian porosity is 1 at 1.01
      const double k = permeability_of<KozenyCarmanPermeability>(J, {{3}, {Phi0}}).k;
      EXPECT_NEAR(k, 3 * packed((J - 1 + Phi0) / J) / packed(Phi0), 1e-11 * k) << Phi0 << " " << J;
    }
  }
}

TEST(Permeability, WithoutExponentALawIsConstantBitForBit)
{
  for (double J : {0.3, 1.0, 1.01, 4.0}) {
    const Porosity porosity{0.75};
    for (const PermeabilityValue &v : {permeability_of<PowerPermeability>(J, {{0.7, 0}, porosity}),
                                       permeability_of<HolmesMowPermeability>(J, {{0.7, 0, 0}, porosity}),
                                       permeability_of<ExponentialPermeability>(J, {{0.7, 0}, porosity})}) {
      EXPECT_EQ(v.k, 0.7);
      EXPECT_EQ(v.dk_dJ, 0);
    }
  }
}

TEST(Airflow, DarcyFluxIsFrameIndifferent)
{
  Random random(43);
  at_points([&](const Data &d) {
    Data turned = d;
    turned.H = random_rotation(random) * d.F() - identity;
    const auto a = d.call<TestPermeability::Parameters>(DarcyKernels<TestPermeability>::flux, {}, 3);
    const auto b = turned.call<TestPermeability::Parameters>(DarcyKernels<TestPermeability>::flux, {}, 3);
    for (int I = 0; I < 3; ++I) EXPECT_NEAR(a[I], b[I], 1e-12 * (1 + std::abs(a[I])));
  });
}

TEST(Ventilator, UniformGasStressTakesThePressureOfTheStep)
{
  at_points([](Data d) {
    d.airflow = false;
    const auto f1 = d.call<NoParameters>(UniformGasKernels::gas_stress, none, 9);
    for (int i = 0; i < 9; ++i) EXPECT_NEAR(f1[i], -0.4 * d.cof()[i], 1e-13 * 10);
    expect_derivative<NoParameters>(d, UniformGasKernels::gas_stress, UniformGasKernels::gas_stress_by_displacement,
                                    none, 9, 9, move_H, vector_by_vector);
  });
}

TEST(LumenPressure, WallTraction)
{
  at_points([](Data d) {
    for (bool airflow : {true, false}) {
      d.airflow = airflow;
      const double p = airflow ? d.p : 0.4;
      const auto f0 = d.call<NoParameters>(LumenPressureKernels::wall, none, 3);
      for (int i = 0; i < 3; ++i) {
        double cof_N = 0;
        for (int J = 0; J < 3; ++J) cof_N += d.cof()[3 * i + J] * d.normal[J];
        EXPECT_NEAR(f0[i], p * cof_N, 1e-13 * 20); // weak form: minus the traction -p cof F N
      }
      expect_derivative<NoParameters>(d, LumenPressureKernels::wall, LumenPressureKernels::wall_by_displacement, none,
                                      3, 9, move_H, nine);
    }
    d.airflow = true;
    expect_derivative<NoParameters>(d, LumenPressureKernels::wall, LumenPressureKernels::wall_by_pressure, none, 3, 1,
                                    move_p, one);
  });
}

/// The normal of the deformed surface, F^-T N.
std::array<double, 3> turned_normal(const Data &d)
{
  const Tensor back = inverse(d.F());
  std::array<double, 3> n{};
  for (int i = 0; i < 3; ++i)
    for (int J = 0; J < 3; ++J) n[i] += back[3 * J + i] * d.normal[J];
  const double length = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
  for (double &component : n) component /= length;
  return n;
}

/// The displacement that a spring resists.
std::array<double, 3> resisted(const Data &d, int direction)
{
  using K = ChestWallKernels;
  std::array<double, 3> n{d.normal[0], d.normal[1], d.normal[2]};
  if (direction == K::full) return {d.u[0], d.u[1], d.u[2]};
  if (direction == K::current_normal) n = turned_normal(d);
  const double u_n = d.u[0] * n[0] + d.u[1] * n[1] + d.u[2] * n[2];
  return {u_n * n[0], u_n * n[1], u_n * n[2]};
}

double length_of(const std::array<double, 3> &v)
{
  return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
}

TEST(ChestWall, SpringsResistTheVectorOrItsNormalPart)
{
  using K = ChestWallKernels;
  at_points([](const Data &d) {
    K::Parameters k{};
    k.stiffness[0] = 0.08;
    k.stiffness[3] = 0.5;
    k.stiffening[3] = 0.7;
    for (int direction : {K::full, K::normal, K::current_normal}) {
      k.direction = direction;
      const auto first = d.call<K::Parameters>(K::spring<0>, k, 3), fourth = d.call<K::Parameters>(K::spring<3>, k, 3);
      const auto way = resisted(d, direction);
      for (int i = 0; i < 3; ++i) { // minus the traction -K_s (1 + s |d|) d
        EXPECT_NEAR(first[i], 0.08 * way[i], 1e-14);
        EXPECT_NEAR(fourth[i], 0.5 * (1 + 0.7 * length_of(way)) * way[i], 1e-14);
      }
      expect_derivative<K::Parameters>(d, K::spring<0>, K::spring_tangent<0>, k, 3, 3, move_u, three);
      expect_derivative<K::Parameters>(d, K::spring<3>, K::spring_tangent<3>, k, 3, 3, move_u, three);
      if (direction != K::current_normal) continue;
      expect_derivative<K::Parameters>(d, K::spring<0>, K::spring_turns<0>, k, 3, 9, move_H, nine);
      expect_derivative<K::Parameters>(d, K::spring<3>, K::spring_turns<3>, k, 3, 9, move_H, nine);
    }
  });
}

TEST(ChestWall, WhatSpringsStoreAndTurningDoesIsTheirWork)
{
  using K = ChestWallKernels;
  Random random(47);
  at_points([&](const Data &end) {
    Data start = end;
    for (int i = 0; i < 9; ++i) start.H[i] += 0.1 * random();
    for (double &u : start.u) u += 0.3 * random();
    const double K_s = 0.5, s = 0.7;
    K::Parameters k{};
    k.stiffness[3] = K_s;
    k.stiffening[3] = s;
    for (int direction : {K::full, K::normal, K::current_normal}) {
      k.direction = direction;
      // the path from start to end in n steps
      const auto at = [&](int i, int n) {
        Data d = end;
        const double share = static_cast<double>(i) / n;
        for (int j = 0; j < 9; ++j) d.H[j] = start.H[j] + share * (end.H[j] - start.H[j]);
        for (int j = 0; j < 3; ++j) d.u[j] = start.u[j] + share * (end.u[j] - start.u[j]);
        return d;
      };
      const auto follow = [&](int n, double sums[3]) {
        for (int i = 1; i <= n; ++i) {
          Data a = at(i - 1, n), b = at(i, n);
          PointState state_a, state_b;
          make_point_state(a.H.data(), nullptr, state_a);
          make_point_state(b.H.data(), nullptr, state_b);
          const Point before{state_a, a.u, 0, nullptr, 0, 0, a.x, a.normal, Step()},
              now{state_b, b.u, 0, nullptr, 0, 0, b.x, b.normal, Step()};
          const auto f = b.call<K::Parameters>(K::spring<3>, k, 3);
          double work = 0;
          for (int j = 0; j < 3; ++j) work += f[j] * (b.u[j] - a.u[j]);
          const double stored = K::stored<3>(now, before, k), turning = K::turning<3>(now, before, k),
                       lost = K::numerical<3>(now, before, k);
          EXPECT_NEAR(work, stored - turning + lost, 1e-14);
          sums[0] += stored;
          sums[1] += turning;
          sums[2] += lost;
        }
      };
      const auto energy = [&](const Data &d) {
        const double a = length_of(resisted(d, direction));
        return K_s * (a * a / 2 + s * a * a * a / 3);
      };
      // int g u . dn by Simpson's rule, with dn/dF . dF by differences of its own
      const auto turns = [&](double share) {
        const auto on_path = [&](double x) {
          Data d = end;
          for (int j = 0; j < 9; ++j) d.H[j] = start.H[j] + x * (end.H[j] - start.H[j]);
          for (int j = 0; j < 3; ++j) d.u[j] = start.u[j] + x * (end.u[j] - start.u[j]);
          return d;
        };
        const double h = 1e-4;
        const auto ahead = turned_normal(on_path(share + h)), behind = turned_normal(on_path(share - h));
        const Data d = on_path(share);
        const auto n = turned_normal(d);
        double u_n = 0, u_dn = 0;
        for (int j = 0; j < 3; ++j) {
          u_n += d.u[j] * n[j];
          u_dn += d.u[j] * (ahead[j] - behind[j]) / (2 * h);
        }
        return K_s * (1 + s * std::abs(u_n)) * u_n * u_dn;
      };
      double expected = 0, once[3] = {0, 0, 0}, coarse[3] = {0, 0, 0}, fine[3] = {0, 0, 0};
      const int n = 200;
      if (direction == K::current_normal)
        for (int i = 0; i <= n; ++i)
          expected += (i == 0 || i == n ? 1 : i % 2 ? 4 : 2) * turns(i / double(n)) / (3 * n);
      follow(1, once);
      follow(50, coarse);
      follow(100, fine);
      const double grown = energy(end) - energy(start);
      EXPECT_NEAR(once[0], grown, 1e-13);
      EXPECT_NEAR(fine[0], grown, 1e-12);
      const double turned = (4 * fine[1] - coarse[1]) / 3; // of second order in the step
      EXPECT_NEAR(turned, expected, 1e-6 * (std::abs(expected) + 1e-6));
      EXPECT_NEAR(fine[2], coarse[2] / 2, 0.03 * std::abs(coarse[2]) + 1e-9); // backward Euler: of the step's order
    }
  });
}

TEST(ChestWall, TheOffsetIsASuctionThatFollows)
{
  using K = ChestWallKernels;
  at_points([](Data d) {
    K::Parameters k{};
    k.offset[2] = 5;
    d.step.load = 0.75;
    const auto f0 = d.call<K::Parameters>(K::pull<2>, k, 3);
    for (int i = 0; i < 3; ++i) {
      double cof_N = 0;
      for (int J = 0; J < 3; ++J) cof_N += d.cof()[3 * i + J] * d.normal[J];
      EXPECT_NEAR(f0[i], -0.75 * 5 * 0.0980665 * cof_N, 1e-12); // minus a traction outward
    }
    expect_derivative<K::Parameters>(d, K::pull<2>, K::pull_by_displacement<2>, k, 3, 9, move_H, nine);
  });
}

TEST(Airflow, AForceOnTheGasDrivesItLikeAGradient)
{
  using Law = TestPermeability;
  using K = DarcyKernels<Law>;
  using P = Both<Law::Parameters, GasForce>;
  const P k{{}, {{0.4, -0.7, 0.25}}};
  at_points([&](Data d) {
    d.step.load = 0.75;
    // Q = k J F^-1 F^-T (F^T f - Grad p): f alone is a gradient of the opposite sign
    const Tensor inverse_F = inverse(d.F()), inverse_C = inverse_F * transposed(inverse_F);
    const double J = det(d.F()), kJ = Law::permeability(J, k.own).k * J;
    double w[3], Q[3] = {0, 0, 0}, still[3] = {0, 0, 0}, work = 0, heat = 0;
    for (int I = 0; I < 3; ++I) {
      w[I] = 0;
      for (int i = 0; i < 3; ++i) w[I] += 0.75 * d.F()[3 * i + I] * k.other.value[i];
    }
    for (int I = 0; I < 3; ++I)
      for (int L = 0; L < 3; ++L) {
        Q[I] += kJ * inverse_C[3 * I + L] * (w[L] - d.grad_p[L]);
        still[I] += kJ * inverse_C[3 * I + L] * -d.grad_p[L];
      }
    const auto added = d.call<P>(K::force_flux, k, 3);
    for (int I = 0; I < 3; ++I) EXPECT_NEAR(added[I], still[I] - Q[I], 1e-12 * (1 + std::abs(Q[I])));
    expect_derivative<P>(d, K::force_flux, K::force_flux_by_displacement, k, 3, 9, move_H, scalar_by_vector);
    // energy: what the force gives, and heat Q . K^-1 Q less that without it
    PointState s;
    make_point_state(d.H.data(), d.rate.data(), s);
    const Point point{s, d.u, d.p, d.grad_p, 0.2, 0, d.x, d.normal, d.step};
    for (int I = 0; I < 3; ++I) {
      work += d.step.dt * Q[I] * w[I];
      heat += d.step.dt * (Q[I] * (w[I] - d.grad_p[I]) - still[I] * -d.grad_p[I]);
    }
    EXPECT_NEAR(K::force_work(point, point, k), work, 1e-12 * (1 + std::abs(work)));
    EXPECT_NEAR(K::force_heat(point, point, k), heat, 1e-12 * (1 + std::abs(heat)));
  });
}

TEST(Gravity, WeightOfTissueAndOfTheAirThatIsThere)
{
  using K = GravityKernels;
  const K::Parameters k{{900, 40, {0.3e-3, -0.8e-3, 0.1e-3}}, {0.7}};
  at_points([&](Data d) {
    d.step.load = 0.6;
    const double R = 0.3 * 900 + (det(d.F()) - 0.3) * 40;
    const auto f0 = d.call<K::Parameters>(K::weight, k, 3);
    for (int i = 0; i < 3; ++i) EXPECT_NEAR(f0[i], -0.6 * R * k.own.force[i], 1e-13);
    expect_derivative<K::Parameters>(d, K::weight, K::weight_by_displacement, k, 3, 9, move_H, nine);
  });
}

TEST(Traction, IsADeadLoadPerReferenceArea)
{
  using K = TractionKernels;
  at_points([](const Data &d) {
    K::Parameters k{};
    for (int i = 0; i < 3; ++i) {
      k.value[0][i] = 0.1 * (i + 1);
      k.value[5][i] = -0.7 * i;
    }
    const auto first = d.call<K::Parameters>(K::load<0>, k, 3), sixth = d.call<K::Parameters>(K::load<5>, k, 3);
    for (int i = 0; i < 3; ++i) {
      EXPECT_NEAR(first[i], -0.1 * (i + 1), 1e-15);
      EXPECT_NEAR(sixth[i], 0.7 * i, 1e-15);
    }
  });
}

struct A {
  static constexpr const char *owner = "a";
  PetscScalar one, two;
};
struct B {
  static constexpr const char *owner = "b";
  PetscScalar three;
};
struct C {
  static constexpr const char *owner = "c";
  PetscScalar absent;
};

TEST(Constants, EveryOwnerFindsItsOwnBlock)
{
  const PetscScalar c[] = {2, constants::tag("b"), 5, constants::tag("a"), 6, 3, 1, 2};
  EXPECT_EQ(constants::get<A>(c).one, 1);
  EXPECT_EQ(constants::get<A>(c).two, 2);
  EXPECT_EQ(constants::get<B>(c).three, 3);
  EXPECT_EQ(constants::get<C>(c).absent, 0);
  const auto both = constants::get<Both<B, A>>(c);
  EXPECT_EQ(both.own.three, 3);
  EXPECT_EQ(both.other.two, 2);
  // the names in use have tags of their own, exact in a double
  const char *owners[] = {"step",    "tissue",  "permeability", "chest_wall", "traction", "ventilator",
                          "airflow", "support", "porosity",     "gravity",    "gas_force"};
  for (const char *a : owners)
    for (const char *b : owners) EXPECT_EQ(constants::tag(a) == constants::tag(b), std::string(a) == b);
}

} // namespace
} // namespace pulmo::test
