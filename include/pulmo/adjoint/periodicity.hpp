/// @file
/// How far the numbers of a run are from those of periodic breaths.
#pragma once

#include "pulmo/adjoint/sweep.hpp"
#include "pulmo/observers/error_bars.hpp"

namespace pulmo {

/// Breath by breath the state of the lung goes from s to M(s). A number of a breath from s changes by
///
///   l . (M(s) - s) + M'^T l . (M(s) - s) + (M'^T)^2 l . (M(s) - s) + ...
///
/// to first order until breaths are periodic, M(s) = s, where l is its derivative by s. The sweep has l where the last
/// breath begins, and goes on through the breaths before it: each makes M'^T of it. So as many terms are known as the
/// run has breaths alike; what follows these is a geometric series.
class Periodicity {
public:
  /// @p rows: the complete signals of the run; all must outlive this.
  Periodicity(const Scene &scene, const std::vector<SignalRow> &rows, const Trajectory &trajectory);
  /// Asks the sweep for what change() is made of.
  void ask(Sweep &sweep);
  /// Of functional @p k of the sweep. Empty if the programme has no breath to repeat.
  std::optional<MoreBreaths> change(const Functional &f, std::size_t k) const;

private:
  const std::vector<SignalRow> &rows_;
  std::size_t first_ = 0, last_ = 0; ///< rows of the last breath
  std::vector<Sweep::Shift> shifts_; ///< where breaths alike begin, the last first
};

} // namespace pulmo
