/// @file
/// Small tensors, random deformations and numerical derivatives for the unit tests.
#pragma once

#include "pulmo/physics/registry.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <memory>
#include <optional>
#include <random>
#include <string>
#include <vector>

namespace pulmo::test {

using Tensor = std::array<double, 9>;
constexpr Tensor identity{1, 0, 0, 0, 1, 0, 0, 0, 1};

/// Uniform random numbers, the same in every run.
class Random {
public:
  explicit Random(unsigned seed) : engine_(seed) {}
  double operator()(double low = -1, double high = 1)
  {
    return low + (high - low) * static_cast<double>(engine_()) / static_cast<double>(std::mt19937::max());
  }
  Tensor tensor(double size)
  {
    Tensor T;
    for (double &t : T) t = (*this)(-size, size);
    return T;
  }

private:
  std::mt19937 engine_;
};

inline Tensor operator*(double a, Tensor T)
{
  for (double &t : T) t *= a;
  return T;
}
inline Tensor operator+(Tensor A, const Tensor &B)
{
  for (int i = 0; i < 9; ++i) A[i] += B[i];
  return A;
}
inline Tensor operator-(const Tensor &A, const Tensor &B)
{
  return A + -1.0 * B;
}
inline Tensor operator*(const Tensor &A, const Tensor &B)
{
  Tensor C{};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      for (int k = 0; k < 3; ++k) C[3 * i + j] += A[3 * i + k] * B[3 * k + j];
  return C;
}
inline Tensor transposed(const Tensor &A)
{
  return {A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8]};
}
inline double dot(const Tensor &A, const Tensor &B)
{
  double s = 0;
  for (int i = 0; i < 9; ++i) s += A[i] * B[i];
  return s;
}
inline double largest(const Tensor &A)
{
  double m = 0;
  for (double a : A) m = std::max(m, std::abs(a));
  return m;
}
/// det A by the Leibniz sum.
template <class T>
T det(const T A[9])
{
  return A[0] * A[4] * A[8] + A[1] * A[5] * A[6] + A[2] * A[3] * A[7] - A[2] * A[4] * A[6] - A[1] * A[3] * A[8] -
         A[0] * A[5] * A[7];
}
inline double det(const Tensor &A)
{
  return det(A.data());
}
/// A^-1 by Gauss-Jordan elimination with pivoting.
inline Tensor inverse(Tensor A)
{
  Tensor B = identity;
  for (int c = 0; c < 3; ++c) {
    int p = c;
    for (int r = c + 1; r < 3; ++r)
      if (std::abs(A[3 * r + c]) > std::abs(A[3 * p + c])) p = r;
    for (int j = 0; j < 3; ++j) {
      std::swap(A[3 * p + j], A[3 * c + j]);
      std::swap(B[3 * p + j], B[3 * c + j]);
    }
    const double pivot = A[3 * c + c];
    for (int j = 0; j < 3; ++j) {
      A[3 * c + j] /= pivot;
      B[3 * c + j] /= pivot;
    }
    for (int r = 0; r < 3; ++r) {
      const double f = A[3 * r + c];
      if (r == c) continue;
      for (int j = 0; j < 3; ++j) {
        A[3 * r + j] -= f * A[3 * c + j];
        B[3 * r + j] -= f * B[3 * c + j];
      }
    }
  }
  return B;
}

/// A rotation about a random axis (Rodrigues).
inline Tensor random_rotation(Random &random)
{
  double n[3] = {random(), random(), random() + 0.1};
  const double length = std::sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), angle = random(0.5, 3);
  for (double &v : n) v /= length;
  const Tensor K{0, -n[2], n[1], n[2], 0, -n[0], -n[1], n[0], 0};
  return identity + std::sin(angle) * K + (1 - std::cos(angle)) * (K * K);
}

/// A deformation gradient with det F = @p J, stretches between 0.75 and 1.8 times J^1/3, shear and rotation.
inline Tensor random_deformation(Random &random, double J)
{
  const double a = random(0.75, 1.3), b = random(0.75, 1.3);
  const Tensor stretch{a, 0, 0, 0, b, 0, 0, 0, 1 / (a * b)};
  const Tensor shear{1, random(-0.3, 0.3), random(-0.3, 0.3), 0, 1, random(-0.3, 0.3), 0, 0, 1};
  return std::cbrt(J) * (random_rotation(random) * (shear * stretch) * random_rotation(random));
}

inline PointState state_of_F(const Tensor &F, const Tensor &rate = {})
{
  PointState s;
  const Tensor H = F - identity;
  make_point_state(H.data(), rate.data(), s);
  return s;
}

/// P' of a law at F, kPa.
inline Tensor stress(const TissueLaw &law, const Tensor &F)
{
  Tensor P;
  law.stress(state_of_F(F), P.data());
  return P;
}

/// dP'/dF of a law at F, kPa, stored [i][k][J][L].
inline std::array<double, 81> tangent(const TissueLaw &law, const Tensor &F)
{
  std::array<double, 81> A;
  law.tangent(state_of_F(F), A.data());
  return A;
}

/// df/dx at 0 by the central five-point formula.
inline double derivative(const std::function<double(double)> &f, double h)
{
  return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h);
}

/// Names of the tissue laws that pulmo offers, the default first.
inline std::vector<std::string> law_names()
{
  std::vector<std::string> names;
  for (const auto &law : Registry::standard().make_tissue_laws()) names.emplace_back(law->name());
  return names;
}

/// The five laws of the paper with its parameters, CM1 ... CM5. pulmo may offer more.
inline std::vector<std::unique_ptr<TissueLaw>> five_laws()
{
  std::vector<std::unique_ptr<TissueLaw>> five;
  for (int i = 1; i <= 5; ++i)
    for (auto &law : Registry::standard().make_tissue_laws())
      if (law->alias() == "cm" + std::to_string(i)) five.push_back(std::move(law));
  return five;
}

/// Free inflation, F = J^1/3 I: p = dW/dJ (kPa) of a law with the paper's parameters in closed form, if there is one.
inline std::optional<double> inflation_pressure(const std::string &law, double J)
{
  const double s = std::pow(J, 2. / 3), t = std::pow(J, -1. / 3);
  if (law == "berger") {
    const double mu = 0.2808, lambda = 0.4212, phi0 = 0.99;
    return mu * t + lambda / 2 * J - (mu + lambda / 2) / (J - 1 + phi0);
  }
  if (law == "ma") {
    const double a = 0.43, b = -0.6, c = 2, g = 3 * (3 * a + b) / 4;
    return c * std::exp(g * (s - 1) * (s - 1)) * 2 * g * (s - 1) * 2 / 3 * t;
  }
  if (law == "birzle") {
    const double c = 0.3567, beta = 1.075, c3 = 5.766e-3;
    return 2 * c * t - 2 * c * std::pow(J, -2 * beta - 1) + 4 * c3 * std::pow(s - 1, 5) * t;
  }
  if (law == "yoshihara") {
    const double c = 1.298, beta = 0.75;
    return 2 * c * t - 2 * c * std::pow(J, -2 * beta - 1);
  }
  if (law == "rausch") return 16.5 / 2 * (J - 1 / J);
  if (law == "patte") { // not of that table: tissue/patte.hpp
    const double beta1 = 0.2, beta2 = 0.4, alpha = 0.16, delta = 0.5;
    return 2 * beta1 * (t - 1 / J) + 4 * beta2 * (1 / t - 1 / J) +
           2 * alpha * delta * (J - 1 / J) * std::exp(delta * (J * J - 1)) * std::pow(J, -2 * delta);
  }
  if (law == "concha") { // neither: all struts stretch by J^1/3, no angle changes
    const double mu = 10.33, d = 0.56, porosity = 0.69;
    return 12 * (1 - porosity) / (12 - 9 * d) * mu / 3 * (t - t * t * t * t);
  }
  return {};
}

/// Root of an increasing function between @p low and @p high.
inline double root(const std::function<double(double)> &f, double low, double high)
{
  for (int i = 0; i < 200; ++i) {
    const double middle = (low + high) / 2;
    (f(middle) < 0 ? low : high) = middle;
  }
  return (low + high) / 2;
}

/// J of free inflation at pressure @p p (kPa), on the branch that starts at J = 1. Of a law without a closed form it is
/// that of its own stress.
inline double inflation_J(const TissueLaw &law, double p)
{
  const auto excess = [&](double J) {
    const auto closed = inflation_pressure(law.name(), J);
    return (closed ? *closed : stress(law, std::cbrt(J) * identity)[0] / std::pow(J, 2. / 3)) - p;
  };
  double low = 0.9;
  while (excess(low + 0.1) < 0 && low < 10) low += 0.1;
  return root(excess, low, low + 0.1);
}

} // namespace pulmo::test
