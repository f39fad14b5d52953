/// @file
/// Wall seconds of a scope.
#pragma once

#include "pulmo/base/petsc.hpp"

namespace pulmo {

/// Adds the seconds of its life to a sum.
class Stopwatch {
public:
  explicit Stopwatch(double &seconds) : seconds_(seconds) { (void)PetscTime(&start_); }
  ~Stopwatch()
  {
    PetscLogDouble end;
    (void)PetscTime(&end);
    seconds_ += end - start_;
  }
  Stopwatch(const Stopwatch &) = delete;
  Stopwatch &operator=(const Stopwatch &) = delete;

private:
  double &seconds_;
  PetscLogDouble start_ = 0;
};

} // namespace pulmo
