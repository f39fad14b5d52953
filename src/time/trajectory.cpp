#include "pulmo/time/trajectory.hpp"

#include <cerrno>
#include <cstring>
#include <unistd.h>

namespace pulmo {

Trajectory::~Trajectory()
{
  if (file_) (void)std::fclose(file_);
}

PetscErrorCode Trajectory::keep(StageRecord record, const TimeScheme &scheme, Vec local)
{
  const auto number = static_cast<PetscInt>(stages_.size());

  PetscFunctionBeginUser;
  if (!complaint_.empty()) PetscFunctionReturn(PETSC_SUCCESS);
  if (number > 0) {
    record.past = {last_, -1};
    if (scheme.looks_back_at() == PointMemory::Past::middle) record.past[1] = middle_;
    if (scheme.looks_back_at() == PointMemory::Past::earlier) record.past[1] = earlier_;
    record.weight = {record.stage.last_weight, record.stage.earlier_weight};
  }
  record.phase_start = phase_start_;
  if (record.row < 0)
    middle_ = number;
  else {
    earlier_ = last_;
    last_ = number;
  }
  stages_.push_back(record);
  const ReadArray x(local);
  PetscInt n;
  PetscCall(VecGetLocalSize(local, &n));
  const std::size_t bytes = static_cast<std::size_t>(n) * sizeof(PetscScalar);
  place_.push_back(0);
  kept_.emplace_back();
  if (used_ + bytes <= memory_) {
    used_ += bytes;
    kept_.back().assign(x.data(), x.data() + n);
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  if (!file_) {
    std::string name = folder_ + "/trajectory-XXXXXX";
    const int descriptor = mkstemp(name.data());
    if (descriptor >= 0) {
      (void)unlink(name.c_str()); // gone with the run, however that ends
      file_ = fdopen(descriptor, "w+b");
    }
  }
  const bool written = file_ && std::fseek(file_, 0, SEEK_END) == 0 && (place_.back() = std::ftell(file_)) >= 0 &&
                       std::fwrite(x.data(), 1, bytes, file_) == bytes && std::fflush(file_) == 0;
  if (!written)
    complaint_ = "the states of the run did not fit into " + folder_ + " (" + std::strerror(errno) +
                 "); give -sweep_memory more, or make room there";
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Trajectory::state(PetscInt stage, Vec local) const
{
  const std::vector<PetscScalar> &kept = kept_[static_cast<std::size_t>(stage)];
  PetscInt n;

  PetscFunctionBeginUser;
  PetscCall(VecGetLocalSize(local, &n));
  WriteArray x(local);
  if (!kept.empty()) {
    std::copy(kept.begin(), kept.end(), x.data());
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  const std::size_t bytes = static_cast<std::size_t>(n) * sizeof(PetscScalar);
  if (bytes == 0) PetscFunctionReturn(PETSC_SUCCESS); // a rank without cells
  const bool read = std::fseek(file_, place_[static_cast<std::size_t>(stage)], SEEK_SET) == 0 &&
                    std::fread(x.data(), 1, bytes, file_) == bytes;
  PetscCheck(read, PETSC_COMM_SELF, PETSC_ERR_FILE_READ, "the states of the run could not be read again: %s",
             std::strerror(errno));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
