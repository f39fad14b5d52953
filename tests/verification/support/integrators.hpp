/// @file
/// The integrators whose order in time is tested: one line each.
#pragma once

namespace pulmo::test {

struct Integrator {
  const char *name;
  const char *options;
  double order;
};

constexpr Integrator integrators[] = {
    {"backward Euler", " -ts_type beuler", 1},
    {"BDF2", " -ts_type bdf", 2},
};

} // namespace pulmo::test
