/// @file
/// Checkpoints of a run: `-checkpoint_every`, `-restart`.
#pragma once

#include "pulmo/observers/output.hpp"

namespace pulmo {

/// Keeps checkpoint.h5 in the run's directory, and the one before it as checkpoint_previous.h5. Either is whole at any
/// moment. Add it as the last observer: it stores what the others remember.
class Checkpoint final : public Observer {
public:
  Checkpoint(const Options &options, const Output &output, const Scene &scene, const Model &model,
             Simulation &simulation)
      : options_(options), output_(output), scene_(scene), model_(model), simulation_(simulation)
  {}

  /// Declares -checkpoint_every and -restart.
  PetscErrorCode declare(Options &options);
  /// The file to go on from; empty for a run that begins at rest.
  const std::string &restart() const { return restart_; }
  /// Its directory.
  std::string restart_directory() const;
  /// Reads it into the simulation and its observers. Refuses a checkpoint of another mesh or scene. Touches no file.
  PetscErrorCode restore();

  /// The first option of the steps and the solver that changed between the sessions of this run, as in "-ts_dt was
  /// '0.1' until t = 0.2 s and '0.05' after it"; empty if none did, or the run began at rest.
  const std::string &numerics_changed() const { return numerics_changed_; }

  /// What is to be known of attempt @p begin at the step after the last accepted one, as a file (on rank 0).
  PetscErrorCode make_attempt(const AttemptBegin &begin, std::vector<char> &image);
  /// Reads that from @p file, as restore() does.
  PetscErrorCode restore_attempt(const std::string &file);

  PetscErrorCode observe(const StepReport &step) override;
  /// Writes a checkpoint after the last accepted step. @p complaint: why it could not, or empty; the older ones are
  /// then as they were.
  PetscErrorCode write(std::string &complaint);
  std::string path() const { return output_.path("checkpoint.h5"); }

private:
  /// Writes or reads all of a file; before attempt @p begin, if there is one.
  PetscErrorCode persist(Archive &archive, const AttemptBegin *begin);
  PetscErrorCode make(const AttemptBegin *begin, std::vector<char> &image);
  /// Marks, scene and mesh: written, or read and compared.
  PetscErrorCode persist_scene(Archive &archive);
  /// Which facets and cells have which names.
  PetscErrorCode persist_names(Archive &archive);
  PetscErrorCode compare_options(const std::string &stored) const;
  /// What a restart may change of steps and solver: read to know whether it did.
  PetscErrorCode persist_numerics(Archive &archive);
  PetscErrorCode persist_programme(Archive &archive);
  PetscErrorCode compare_programme(const std::vector<Phase> &stored, PetscReal time) const;

  const Options &options_;
  const Output &output_;
  const Scene &scene_;
  const Model &model_;
  Simulation &simulation_;
  NodeOrder order_;
  PetscReal every_ = 0;
  std::string restart_, numerics_changed_;
  std::string named_; ///< the option that named the file that is read, and the file
  std::optional<Schedule> schedule_;
  std::optional<PetscReal> cut_from_; ///< the steps after this time are other ones because the run ends, s
  bool spare_previous_ = false;       ///< the run came from checkpoint_previous.h5: the one after it may be bad
};

} // namespace pulmo
