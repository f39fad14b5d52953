/// @file
/// The folder that a failed run leaves, and `-replay`, which repeats its last attempts from there.
#pragma once

#include "pulmo/input/replay_file.hpp"
#include "pulmo/observers/checkpoint.hpp"

namespace pulmo {

/// A run that could not go on leaves DIR/replay: the last good state, how its last attempts began and went, all
/// options. A replay repeats these attempts, and nothing before them. Add it after the checkpoint.
///
/// It ends in the same place bit for bit, on the same ranks, unless the solver keeps more of its past than Jacobians
/// and factors; it says whether it did.
class Replay final : public Observer {
public:
  Replay(const Options &options, const Output &output, Simulation &simulation, Checkpoint &checkpoint)
      : options_(options), output_(output), simulation_(simulation), checkpoint_(checkpoint)
  {}

  /// Declares -replay.
  PetscErrorCode declare(Options &options);
  bool in_use() const { return !folder_.empty(); }
  /// Refuses to repeat a run of other ranks, of another version or of another mesh.
  PetscErrorCode check();
  /// Repeats the attempts, writes nothing, and tells how they went. @p finished: a step was accepted this time.
  PetscErrorCode make(bool &finished);

  /// Keeps what is needed of a run that is about to end because its steps crawl.
  PetscErrorCode observe(const StepReport &step) override;
  /// Writes the folder. @p text: where it is, or why there is none, to follow a sentence; empty where the run did not
  /// fail in a step.
  PetscErrorCode write(const std::string &failure, std::string &text);

private:
  /// How an attempt went, beside how number @p i of the run did. @p same: bit for bit.
  std::string compared(const AttemptRecord &now, std::size_t i, bool &same) const;

  const Options &options_;
  const Output &output_;
  Simulation &simulation_;
  Checkpoint &checkpoint_;
  std::string folder_;
  ReplayFile file_;               ///< on rank 0
  std::vector<char> crawl_image_; ///< before the step that may be the last of a crawl, on rank 0
};

} // namespace pulmo
