// What the effects of a scene put together: the constants that their kernels read.
#include "pulmo/physics/effect.hpp"

#include <algorithm>
#include <functional>

namespace pulmo {

PetscErrorCode Composition::check_parameters(MPI_Comm comm) const
{
  PetscFunctionBeginUser;
  for (const Reader &reader : readers_) {
    const auto n = std::count_if(parameters_.begin(), parameters_.end(), [&](const ParameterBlock &block) {
      return constants::tag(block.owner) == constants::tag(reader.owner);
    });
    PetscCheck(n > 0, comm, PETSC_ERR_ARG_WRONGSTATE,
               "effect %s: '%s' reads the parameters of '%s', which no effect hands over; call "
               "Composition::parameters in terms()",
               reader.effect.c_str(), reader.term.c_str(), reader.owner);
    PetscCheck(n == 1, comm, PETSC_ERR_ARG_WRONGSTATE,
               "effect %s: the parameters of '%s' are handed over %d times; give each block an owner of its own",
               reader.effect.c_str(), reader.owner, (int)n);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscInt Composition::constant_at(const PetscReal *parameter, const char **owner) const
{
  PetscInt offset = 1 + 2 * static_cast<PetscInt>(1 + parameters_.size() + memories_.size()) +
                    static_cast<PetscInt>(sizeof(Step) / sizeof(PetscScalar)); // as constants() lists them
  for (const ParameterBlock &block : parameters_) {
    if (!std::less<>()(parameter, block.data) && std::less<>()(parameter, block.data + block.count)) {
      *owner = block.owner;
      return offset + static_cast<PetscInt>(parameter - block.data);
    }
    offset += block.count;
  }
  return -1;
}

std::vector<std::string> Composition::surfaces_that_read(const char *owner) const
{
  std::vector<std::string> list;
  for (const Reader &reader : readers_)
    if (!reader.surface.empty() && constants::tag(reader.owner) == constants::tag(owner))
      list.push_back(reader.surface);
  return list;
}

std::vector<PetscScalar> Composition::constants(const Step &step) const
{
  const std::size_t blocks = 1 + parameters_.size() + memories_.size();
  std::vector<PetscScalar> all(1, static_cast<PetscScalar>(blocks));
  auto offset = static_cast<PetscInt>(1 + 2 * blocks);
  const auto list = [&](PetscScalar tag, PetscInt count) {
    all.push_back(tag);
    all.push_back(static_cast<PetscScalar>(offset));
    offset += count;
  };
  const auto *of_step = reinterpret_cast<const PetscScalar *>(&step);
  constexpr auto step_size = static_cast<PetscInt>(sizeof(Step) / sizeof(PetscScalar));

  // the step is asked for by every kernel: first in the directory
  list(constants::tag(Step::owner), step_size);
  for (const ParameterBlock &block : parameters_) list(constants::tag(block.owner), block.count);
  for (const MemorySpec &memory : memories_) list(constants::memory_tag(memory.owner), 1);
  all.insert(all.end(), of_step, of_step + step_size);
  for (const ParameterBlock &block : parameters_) all.insert(all.end(), block.data, block.data + block.count);
  for (const MemorySpec &memory : memories_) all.push_back(static_cast<PetscScalar>(memory.offset));
  return all;
}

} // namespace pulmo
