/// @file
/// The accepted stages of a run, kept so that a backward sweep can make their equations again.
#pragma once

#include "pulmo/fem/point_memory.hpp"
#include "pulmo/time/airway.hpp"

#include <array>
#include <cstdio>
#include <string>
#include <vector>

namespace pulmo {

/// A stage that was accepted. Numbers of stages count from the start of the run, which is stage 0 and has no equations.
struct StageRecord {
  PetscReal time = 0;                       ///< at its end, s
  Stage stage{1};                           ///< what kernels were told of it
  PetscReal load = 1;                       ///< share of the dead loads that was there
  std::array<PetscInt, 2> past = {-1, -1};  ///< stages that its rates look back at; -1: none
  std::array<PetscReal, 2> weight = {0, 0}; ///< of these in a rate, 1/s
  PetscInt row = -1;                        ///< of the signals that it ends; -1: the half step with which BDF2 begins
  PetscInt phase = 0;                       ///< number of its phase among those of the programme
  PetscInt phase_start = 0;                 ///< stage from which its phase began
  Airway::Condition airway;
};

/// Keeps stages, their states and what effects remember of these: in memory, or beyond a limit in a file that is gone
/// with the run.
class Trajectory {
public:
  /// @p memory: bytes on this rank; @p folder: where the file may be.
  Trajectory(std::size_t memory, std::string folder) : memory_(memory), folder_(std::move(folder)) {}
  ~Trajectory();
  Trajectory(const Trajectory &) = delete;
  Trajectory &operator=(const Trajectory &) = delete;

  /// The stage accepted last ends the one phase and begins the next.
  void begin_phase() { phase_start_ = last_; }
  /// Adds a stage with the local state @p local and what is @p remembered of it. What it looks back at follows from @p
  /// scheme. A file that cannot be written does not end the run: from then on nothing is kept, and complaint() tells
  /// why.
  PetscErrorCode keep(StageRecord record, const TimeScheme &scheme, Vec local, const PointMemory::Values &remembered);
  const std::vector<StageRecord> &stages() const { return stages_; }
  /// Why this rank does not have all states; empty: it has.
  const std::string &complaint() const { return complaint_; }
  /// Fills @p local with the state of a stage, constrained values in place.
  PetscErrorCode state(PetscInt stage, Vec local) const;
  /// What is remembered of that state.
  PetscErrorCode remembered(PetscInt stage, PointMemory::Values &values) const;

private:
  /// Copies the entries of a stage from @p begin on.
  PetscErrorCode read(PetscInt stage, std::size_t begin, std::size_t count, PetscScalar *values) const;

  std::size_t memory_, used_ = 0;
  std::string folder_, complaint_;
  std::vector<StageRecord> stages_;
  std::size_t state_ = 0, remembered_ = 0;     ///< entries of a stage
  std::vector<std::vector<PetscScalar>> kept_; ///< [stage]: the state, then what is remembered; empty: in the file
  std::vector<std::int64_t> place_;            ///< [stage]: in the file
  std::FILE *file_ = nullptr;
  PetscInt last_ = -1, earlier_ = -1, middle_ = -1, phase_start_ = 0;
};

} // namespace pulmo
