#include "pulmo/time/trajectory.hpp"

#include <cerrno>
#include <cstring>
#include <unistd.h>

namespace pulmo {

Trajectory::~Trajectory()
{
  if (file_) (void)std::fclose(file_);
}

PetscErrorCode Trajectory::keep(StageRecord record, const TimeScheme &scheme, Vec local,
                                const PointMemory::Values &remembered)
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
  state_ = static_cast<std::size_t>(n);
  remembered_ = remembered.size();
  std::vector<PetscScalar> values(x.data(), x.data() + n);
  values.insert(values.end(), remembered.begin(), remembered.end());
  const std::size_t bytes = values.size() * sizeof(PetscScalar);
  place_.push_back(0);
  kept_.emplace_back();
  if (used_ + bytes <= memory_) {
    used_ += bytes;
    kept_.back() = std::move(values);
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
                       std::fwrite(values.data(), 1, bytes, file_) == bytes && std::fflush(file_) == 0;
  if (!written)
    complaint_ = "the states of the run did not fit into " + folder_ + " (" + std::strerror(errno) +
                 "); give -sweep_memory more, or make room there";
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Trajectory::state(PetscInt stage, Vec local) const
{
  PetscFunctionBeginUser;
  WriteArray x(local);
  PetscCall(read(stage, 0, state_, x.data()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Trajectory::remembered(PetscInt stage, PointMemory::Values &values) const
{
  PetscFunctionBeginUser;
  values.resize(remembered_);
  PetscCall(read(stage, state_, remembered_, values.data()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Trajectory::read(PetscInt stage, std::size_t begin, std::size_t count, PetscScalar *values) const
{
  const std::vector<PetscScalar> &kept = kept_[static_cast<std::size_t>(stage)];

  PetscFunctionBeginUser;
  if (count == 0) PetscFunctionReturn(PETSC_SUCCESS); // a rank without cells
  if (!kept.empty()) {
    std::copy_n(kept.data() + begin, count, values);
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  const auto place = place_[static_cast<std::size_t>(stage)] + static_cast<std::int64_t>(begin * sizeof(PetscScalar));
  const bool good =
      std::fseek(file_, place, SEEK_SET) == 0 && std::fread(values, sizeof(PetscScalar), count, file_) == count;
  PetscCheck(good, PETSC_COMM_SELF, PETSC_ERR_FILE_READ, "the states of the run could not be read again: %s",
             std::strerror(errno));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
