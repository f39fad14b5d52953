#include "pulmo/physics/law_range.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <sstream>

namespace pulmo {

namespace {

/// Some laws have no stiffness at rest (CM5 against shear): only what is negative beyond rounding is lost.
constexpr PetscReal rounding = 1e-8;

/// Directions that are tried per quarter of a circle, and the search around the softest of them.
constexpr int directions = 6, refinements = 30;

using Direction = std::array<PetscReal, 3>;

/// Least eigenvalue of a symmetric 3 x 3 matrix.
PetscReal least_eigenvalue(PetscReal S[3][3])
{
  diagonalize(S, nullptr);
  return std::min({S[0][0], S[1][1], S[2][2]});
}

/// Of A_iJkL n_J n_L; @p A as TissueLaw::tangent has it, [i][k][J][L].
PetscReal stiffness_along(const PetscScalar A[81], const Direction &n)
{
  PetscReal Q[3][3] = {};
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k)
      for (int J = 0; J < 3; ++J)
        for (int L = 0; L < 3; ++L) Q[i][k] += A[27 * i + 9 * k + 3 * J + L] * n[J] * n[L];
  return least_eigenvalue(Q);
}

Direction direction(PetscReal polar, PetscReal azimuth)
{
  return {std::sin(polar) * std::cos(azimuth), std::sin(polar) * std::sin(azimuth), std::cos(polar)};
}

/// F = J^(1/3) I.
PointState inflated_state(PetscReal J)
{
  PetscScalar H[9] = {0};
  PointState state;
  for (int i = 0; i < 9; i += 4) H[i] = std::expm1(std::log(J) / 3);
  make_point_state(H, nullptr, state);
  return state;
}

/// Least stiffness against a plane wave in free inflation, plus what rounding makes of it.
PetscReal wave_stiffness(const TissueLaw &law, PetscReal J, const PetscScalar *constants)
{
  PetscScalar A[81];
  law.tangent(inflated_state(J), constants, A);
  PetscReal size = 0;
  for (const PetscScalar a : A) size = std::max(size, std::abs(a));
  // laws are functions of invariants: in free inflation all directions are alike
  return stiffness_along(A, {1, 0, 0}) + rounding * size;
}

/// Where f turns negative on the way from J = 1 to @p end, in steps of half a per cent; nothing if it does not, or
/// stops to be a number first (a barrier, an overflow).
template <class F>
std::optional<PetscReal> first_loss(PetscReal end, F f)
{
  constexpr PetscReal step = 0.005;
  constexpr int halvings = 60;
  const PetscReal sign = end > 1 ? 1 : -1;
  PetscReal good = 1;
  for (int i = 1; sign * std::exp(sign * i * step) <= sign * end; ++i) {
    PetscReal bad = std::exp(sign * i * step);
    const PetscReal value = f(bad);
    if (!std::isfinite(value)) return {};
    if (value < 0) {
      for (int n = 0; n < halvings; ++n) {
        const PetscReal J = (good + bad) / 2;
        (f(J) < 0 ? bad : good) = J;
      }
      return good;
    }
    good = bad;
  }
  return {};
}

} // namespace

AcousticStiffness acoustic_stiffness(const TissueLaw &law, const PointState &state, bool refine,
                                     const PetscScalar *constants)
{
  PetscScalar A[81];
  AcousticStiffness found;
  PetscReal polar = 0, azimuth = 0;

  law.tangent(state, constants, A);
  const auto look = [&](PetscReal at_polar, PetscReal at_azimuth) {
    const Direction n = direction(at_polar, at_azimuth);
    const PetscReal stiffness = stiffness_along(A, n);
    if (!(stiffness < found.least)) return false;
    found.least = stiffness;
    std::copy(n.begin(), n.end(), found.direction);
    polar = at_polar;
    azimuth = at_azimuth;
    return true;
  };
  PetscReal step = PETSC_PI / (2 * directions); // n and -n are the same: half a sphere
  for (int i = 0; i <= directions; ++i)
    for (int j = 0; j < (i == 0 ? 1 : 4 * directions); ++j) look(i * step, j * step);
  for (int i = 0; refine && i < refinements; ++i) {
    const PetscReal p = polar, a = azimuth;
    bool better = false;
    for (PetscReal dp : {-step, PetscReal(0), step})
      for (PetscReal da : {-step, PetscReal(0), step}) better = look(p + dp, a + da) || better;
    if (!better) step /= 2;
  }
  return found;
}

PetscReal inflation_stiffness(const TissueLaw &law, PetscReal J, const PetscScalar *constants)
{
  const PetscReal stretch = std::cbrt(J);
  PetscScalar H[9] = {0}, P[9], A[81];
  PointState state;
  for (int i = 0; i < 9; i += 4) H[i] = stretch - 1;
  make_point_state(H, nullptr, state);
  law.stress(state, constants, P);
  law.tangent(state, constants, A);
  PetscReal first = 0, second = 0; // derivatives of W by the stretch
  for (int i = 0; i < 3; ++i) {
    first += P[4 * i];
    for (int k = 0; k < 3; ++k) second += A[27 * i + 9 * k + 3 * i + k];
  }
  // p = W'/(3 s^2), dJ = 3 s^2 ds
  return (second - 2 * first / stretch) / (9 * std::pow(stretch, 4));
}

std::string unstable_at_rest(const TissueLaw &law, const PetscScalar *constants)
{
  const PetscScalar zero[9] = {0};
  PetscScalar A[81];
  PointState state;
  std::ostringstream text;

  make_point_state(zero, nullptr, state);
  law.tangent(state, constants, A);
  PetscReal size = 0;
  for (const PetscScalar a : A) size = std::max(size, std::abs(a));
  // laws are functions of invariants: at rest all directions are alike
  const PetscReal inflation = inflation_stiffness(law, 1, constants), wave = stiffness_along(A, {1, 0, 0});
  text.precision(3);
  if (!(inflation > rounding * size))
    text << "free inflation has dp/dJ = " << inflation << " kPa, so that it shrinks where gas presses from inside";
  if (!(wave >= -rounding * size))
    text << (text.str().empty() ? "" : "; ") << "the least stiffness against a plane wave is " << wave
         << " kPa, so that it shears by itself";
  return text.str();
}

PetscReal inflation_pressure(const TissueLaw &law, PetscReal J, const PetscScalar *constants)
{
  const PointState state = inflated_state(J);
  PetscScalar P[9];
  law.stress(state, constants, P);
  return P[0] / (state.F[0] * state.F[0]); // dW/ds = 3 P, dJ/ds = 3 s^2
}

LawRange law_range(const TissueLaw &law, const PetscScalar *constants)
{
  LawRange range;
  // beyond a barrier, or where it overflows, the energy is no number, though its derivatives may be
  const auto within = [&](PetscReal J, PetscReal value) {
    return std::isfinite(law.energy(inflated_state(J), constants)) ? value
                                                                   : std::numeric_limits<PetscReal>::quiet_NaN();
  };
  const auto stiffness = [&](PetscReal J) { return within(J, inflation_stiffness(law, J, constants)); };
  const auto wave = [&](PetscReal J) { return within(J, wave_stiffness(law, J, constants)); };
  // the fall of stiffness over an interval that is short beside the steps of first_loss(), and long beside rounding
  const auto fall = [&](PetscReal J) { return stiffness(J * (1 - 1e-4)) - stiffness(J * (1 + 1e-4)); };
  const auto state = [&](const std::optional<PetscReal> &J) -> std::optional<LawRange::State> {
    if (!J) return {};
    return LawRange::State{*J, inflation_pressure(law, *J, constants)};
  };

  range.largest = state(first_loss(LawRange::largest_J, stiffness));
  range.least = state(first_loss(LawRange::least_J, stiffness));
  range.waves_above = state(first_loss(LawRange::largest_J, wave));
  range.waves_below = state(first_loss(LawRange::least_J, wave));
  if (!range.largest && fall(1) > 0) range.softest = state(first_loss(LawRange::largest_J, fall));
  if (range.softest) range.softest_share = stiffness(range.softest->J) / stiffness(1);
  return range;
}

std::optional<PetscReal> inflated_J(const TissueLaw &law, PetscReal pressure, const PetscScalar *constants,
                                    LawRange::State *end)
{
  constexpr int halvings = 100;
  const auto is_number = [&](PetscReal J) { return std::isfinite(law.energy(inflated_state(J), constants)); };
  const auto excess = [&](PetscReal J) { // a barrier holds any suction, an overflow any pressure
    if (!is_number(J)) return J < 1 ? -PETSC_MAX_REAL : PETSC_MAX_REAL;
    return inflation_pressure(law, J, constants) - pressure;
  };
  const bool up = excess(1) < 0;
  const auto reaches = [&](PetscReal J) { return up ? excess(J) >= 0 : excess(J) <= 0; };
  PetscReal last = 1;
  // the search for a limit of pressure ends where the pressure is reached
  const auto stiffness = [&](PetscReal J) {
    const PetscReal dp_dJ =
        is_number(J) ? inflation_stiffness(law, J, constants) : std::numeric_limits<PetscReal>::quiet_NaN();
    last = J;
    return dp_dJ >= 0 && reaches(J) ? std::numeric_limits<PetscReal>::quiet_NaN() : dp_dJ;
  };
  const auto limit = first_loss(up ? LawRange::largest_J : LawRange::least_J, stiffness);
  if (limit) last = *limit;
  if (end) *end = {last, is_number(last) ? inflation_pressure(law, last, constants) : excess(last)};
  if (!reaches(last)) return {};
  PetscReal low = up ? 1 : last, high = up ? last : 1;
  for (int n = 0; n < halvings; ++n) {
    const PetscReal J = (low + high) / 2;
    (excess(J) < 0 ? low : high) = J;
  }
  return (low + high) / 2;
}

} // namespace pulmo
