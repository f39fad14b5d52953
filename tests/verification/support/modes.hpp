/// @file
/// Series solutions of linear consolidation problems (incompressible constituents, Biot coefficient 1) whose Laplace
/// transform is known, and the elastic moduli that pulmo's laws have at F = I.
///
/// Times are c_v t / a^2 with c_v = k M. A quantity with the transform N(y) / (s D(y)), s = -y^2, has poles at s = 0
/// and at the real roots alpha of D:
///   f(t) = N(0)/D(0) + sum 2 N(alpha) / (alpha D'(alpha)) exp(-alpha^2 t).
/// Backward Euler without error in space makes (1 + alpha^2 t/steps)^-steps of each exponential.
#pragma once

#include <cmath>
#include <complex>
#include <functional>
#include <vector>

namespace pulmo::test {

using Complex = std::complex<double>;

/// CM4 (yoshihara) at small strain: W = c (I1 - 3) + c/beta (I3^-beta - 1).
struct SmallStrain {
  double c, beta;
  double shear() const { return 2 * c; }                         ///< mu, kPa
  double confined() const { return 4 * c * (1 + beta); }         ///< M = lambda + 2 mu, kPa
  double poisson() const { return beta / (1 + 2 * beta); }       ///< nu
  double young() const { return 2 * shear() * (1 + poisson()); } ///< kPa
};

/// sin y / y.
inline Complex sinc(Complex y)
{
  return std::abs(y) < 1e-3 ? 1. - y * y / 6. : std::sin(y) / y;
}
/// 3 (sin y - y cos y) / y^3: the mean of sin(y r)/(y r) over the unit ball.
inline Complex mean_sinc(Complex y)
{
  return std::abs(y) < 0.05 ? 1. - y * y / 10. + y * y * y * y / 280.
                            : 3. * (std::sin(y) - y * std::cos(y)) / (y * y * y);
}
/// J_order(y) (order 0 or 1), divided by y for order 1: both are even. Power series, Hankel's expansion beyond 12.
inline Complex bessel(int order, Complex y)
{
  if (y.real() < 0) y = -y;
  if (std::abs(y) < 12) {
    Complex term = order == 0 ? 1 : 0.5, sum = term;
    for (int k = 1; k < 60; ++k) sum += term *= -y * y / (4. * k * (k + order));
    return sum;
  }
  Complex P = 1, Q = 0, term = 1;
  for (int k = 1; k <= 20; ++k) {
    term *= (4. * order * order - (2. * k - 1) * (2. * k - 1)) / (8. * k * y);
    (k % 2 ? Q : P) += k % 4 < 2 ? term : -term;
  }
  const Complex chi = y - (0.5 * order + 0.25) * M_PI;
  return std::sqrt(2. / (M_PI * y)) * (P * std::cos(chi) - Q * std::sin(chi)) / (order == 0 ? 1. : y);
}

class Modes {
public:
  using Transform = std::function<Complex(Complex y)>; ///< even in y, real on the real axis

  explicit Modes(Transform D, int count = 1500) : D_(std::move(D))
  {
    const double step = 0.05;
    double a = 1e-6;
    while (static_cast<int>(root_.size()) < count) {
      const double b = a + step;
      if (real(a) * real(b) < 0) {
        double low = a, high = b;
        for (int i = 0; i < 60; ++i) {
          const double middle = (low + high) / 2;
          (real(low) * real(middle) <= 0 ? high : low) = middle;
        }
        root_.push_back(low);
        slope_.push_back(D_({low, 1e-30}).imag() / 1e-30); // complex step
      }
      a = b;
    }
  }

  /// The quantity N / (s D) at time @p t; @p steps > 0: after as many backward Euler steps.
  double value(const Transform &N, double t, int steps = 0) const
  {
    double sum = N(0).real() / D_(0).real();
    for (std::size_t i = 0; i < root_.size(); ++i) {
      const double lambda = root_[i] * root_[i];
      const double decay = steps == 0 ? std::exp(-lambda * t) : std::pow(1 + lambda * t / steps, -steps);
      sum += 2 * N(root_[i]).real() / (root_[i] * slope_[i]) * decay;
    }
    return sum;
  }
  /// The same by numerical inversion on Talbot's contour (parameters of Weideman 2006): knows nothing of roots.
  double inverted(const Transform &N, double t) const
  {
    constexpr int terms = 24;
    double sum = 0;
    for (int k = 0; k < terms; ++k) {
      const double theta = M_PI * (2 * k + 1 - terms) / terms, b = 0.6407 * theta;
      const Complex z = terms * Complex(0.5017 * theta / std::tan(b) - 0.6122, 0.2645 * theta);
      const Complex dz = terms * Complex(0.5017 / std::tan(b) - 0.5017 * b / std::pow(std::sin(b), 2), 0.2645);
      const Complex y = std::sqrt(-z / t);
      sum += (std::exp(z) * N(y) / (z * D_(y)) * dz / Complex(0, 1)).real() / terms; // s dt = z
    }
    return sum;
  }
  double root(int i) const { return root_[i]; }

private:
  double real(double y) const { return D_(y).real(); }

  Transform D_;
  std::vector<double> root_, slope_;
};

} // namespace pulmo::test
