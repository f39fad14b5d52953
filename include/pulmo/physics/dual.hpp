/// @file
/// Dual numbers: a number with its derivatives by N variables, nestable for second derivatives. Tissue laws that give
/// no more than W get their derivatives from them.
#pragma once

#include <array>
#include <cmath>

namespace pulmo {

template <class T, int N>
struct Dual {
  T v{};
  std::array<T, N> d{};

  Dual() = default;
  Dual(double value) : v(value) {}

  Dual &operator+=(const Dual &b) { return *this = *this + b; }
  Dual &operator*=(const Dual &b) { return *this = *this * b; }
  friend Dual operator-(const Dual &a) { return a * -1.0; }
  friend Dual operator+(const Dual &a, const Dual &b)
  {
    Dual r;
    r.v = a.v + b.v;
    for (int i = 0; i < N; ++i) r.d[i] = a.d[i] + b.d[i];
    return r;
  }
  friend Dual operator-(const Dual &a, const Dual &b)
  {
    Dual r;
    r.v = a.v - b.v;
    for (int i = 0; i < N; ++i) r.d[i] = a.d[i] - b.d[i];
    return r;
  }
  friend Dual operator*(const Dual &a, const Dual &b)
  {
    Dual r;
    r.v = a.v * b.v;
    for (int i = 0; i < N; ++i) r.d[i] = a.d[i] * b.v + a.v * b.d[i];
    return r;
  }
  friend Dual operator/(const Dual &a, const Dual &b)
  {
    Dual r;
    r.v = a.v / b.v;
    for (int i = 0; i < N; ++i) r.d[i] = (a.d[i] - r.v * b.d[i]) / b.v;
    return r;
  }
  friend Dual operator*(const Dual &a, double b)
  {
    Dual r;
    r.v = a.v * b;
    for (int i = 0; i < N; ++i) r.d[i] = a.d[i] * b;
    return r;
  }
  friend Dual operator*(double a, const Dual &b) { return b * a; }
  friend Dual operator/(const Dual &a, double b)
  {
    Dual r;
    r.v = a.v / b;
    for (int i = 0; i < N; ++i) r.d[i] = a.d[i] / b;
    return r;
  }
  friend Dual operator+(const Dual &a, double b)
  {
    Dual r = a;
    r.v = r.v + b;
    return r;
  }
  friend Dual operator+(double a, const Dual &b) { return b + a; }
  friend Dual operator-(const Dual &a, double b) { return a + -b; }
  friend Dual operator-(double a, const Dual &b) { return a + -b; }

  /// f(a) where f = value and f' = slope at a.v.
  friend Dual chain(const Dual &a, const T &value, const T &slope)
  {
    Dual r;
    r.v = value;
    for (int i = 0; i < N; ++i) r.d[i] = a.d[i] * slope;
    return r;
  }
};

/// N variables: numbers whose derivative by themselves is 1.
template <class T, int N>
void seed(const T value[], Dual<T, N> (&variable)[N])
{
  for (int i = 0; i < N; ++i) {
    variable[i].v = value[i];
    variable[i].d[i] = T(1.0);
  }
}

// so that a formula reads the same for plain numbers
using std::cos;
using std::exp;
using std::expm1;
using std::log;
using std::log1p;
using std::pow;
using std::sin;
using std::sqrt;

template <class T, int N>
Dual<T, N> sin(const Dual<T, N> &a)
{
  return chain(a, T(sin(a.v)), T(cos(a.v)));
}
template <class T, int N>
Dual<T, N> cos(const Dual<T, N> &a)
{
  return chain(a, T(cos(a.v)), T(sin(a.v)) * -1.0);
}
template <class T, int N>
Dual<T, N> exp(const Dual<T, N> &a)
{
  const T e = exp(a.v);
  return chain(a, e, e);
}
template <class T, int N>
Dual<T, N> log(const Dual<T, N> &a)
{
  return chain(a, T(log(a.v)), T(T(1.0) / a.v));
}
/// exp(a) - 1, accurate near a = 0.
template <class T, int N>
Dual<T, N> expm1(const Dual<T, N> &a)
{
  const T e = expm1(a.v);
  return chain(a, e, T(e + 1.0));
}
/// log(1 + a), accurate near a = 0.
template <class T, int N>
Dual<T, N> log1p(const Dual<T, N> &a)
{
  return chain(a, T(log1p(a.v)), T(T(1.0) / (a.v + 1.0)));
}
template <class T, int N>
Dual<T, N> sqrt(const Dual<T, N> &a)
{
  const T root = sqrt(a.v);
  return chain(a, root, T(T(0.5) / root));
}
template <class T, int N>
Dual<T, N> pow(const Dual<T, N> &a, double n)
{
  return chain(a, T(pow(a.v, n)), n == 0 ? T(0.0) : T(pow(a.v, n - 1) * n));
}

} // namespace pulmo
