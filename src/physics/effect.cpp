// What the effects of a scene put together: the constants that their kernels read.
#include "pulmo/physics/effect.hpp"

#include "pulmo/mesh/mesh.hpp"

#include <algorithm>
#include <functional>

namespace pulmo {

namespace {

bool same_owner(const char *a, const char *b)
{
  return a && b && constants::tag(a) == constants::tag(b);
}

} // namespace

Memory PlaceMemory::nearest(const PetscReal at[3]) const
{
  PetscInt best = 0;
  PetscReal least = PETSC_MAX_REAL;

  for (PetscInt q = 0; q < static_cast<PetscInt>(x.size() / 3); ++q) {
    PetscReal square = 0;
    for (int d = 0; d < 3; ++d) square += (x[3 * q + d] - at[d]) * (x[3 * q + d] - at[d]);
    if (square < least) {
      least = square;
      best = q;
    }
  }
  return {first.last + best * width, first.earlier ? first.earlier + best * width : nullptr};
}

Memory PlaceMemory::find(const PetscReal at[3], const PetscScalar c[])
{
  const PetscInt offset = constants::offset_of(constants::tag(owner), c);
  if (offset == 0) return {};
  const auto *place = constants::to_pointer<const PlaceMemory *>(c[offset]);
  return place && place->first.last ? place->nearest(at) : Memory();
}

void Composition::remember(std::vector<Quantity> quantities, Callback<MemoryFunction> value, const std::string &surface)
{
  PetscInt offset = 0;

  for (const MemorySpec &m : memories_)
    if (m.surface.empty() == surface.empty())
      offset = std::max(offset, m.offset + static_cast<PetscInt>(m.quantities.size()));
  for (const MemorySpec &m : memories_) // kernels know one place for all surfaces
    if (!m.surface.empty() && !surface.empty() && same_owner(m.owner, value.owners[0])) offset = m.offset;
  memories_.push_back({effect_, surface, value.owners[0], std::move(quantities), value.function, nullptr, offset, false,
                       nullptr, nullptr});
  note_readers(effect_, "memory", surface, value.owners);
}

void Composition::average(std::size_t quantity, const std::string &name)
{
  column_of({effect_, quantity, 1 / mesh_.volume(), Over::cells, name, true});
}

PetscInt Composition::memory_width(const std::string &surface) const
{
  PetscInt width = 0;
  for (const MemorySpec &m : memories_)
    if (m.surface == surface) width = std::max(width, m.offset + static_cast<PetscInt>(m.quantities.size()));
  return width;
}

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
  for (const MemorySpec &m : memories_) {
    PetscCheck(m.owner, comm, PETSC_ERR_ARG_WRONGSTATE,
               "effect %s remembers by a kernel without parameters, which cannot see it; give it a struct of "
               "parameters",
               m.effect.c_str());
    for (const MemorySpec &other : memories_) {
      if (&m == &other || m.surface.empty() != other.surface.empty()) continue;
      if (!same_owner(m.owner, other.owner)) continue;
      PetscCheck(m.surface != other.surface && m.quantities.size() == other.quantities.size(), comm,
                 PETSC_ERR_ARG_WRONGSTATE,
                 "effect %s: what kernels with the parameters of '%s' remember has two meanings; call "
                 "Composition::remember once for the cells and once for each surface, with the same quantities on all "
                 "surfaces",
                 m.effect.c_str(), m.owner);
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscInt Composition::constant_at(const PetscReal *parameter, const char **owner) const
{
  PetscInt offset = 1 + 2 * constant_blocks() +
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

bool Composition::read_by_scalars(const PetscReal *setting) const
{
  return std::any_of(scalar_groups_.begin(), scalar_groups_.end(), [setting](const ScalarGroup &group) {
    return std::find(group.parameters.begin(), group.parameters.end(), setting) != group.parameters.end();
  });
}

const char *Composition::reader_in_place(const PetscReal *setting) const
{
  const auto found =
      std::find_if(in_place_.begin(), in_place_.end(), [setting](const auto &one) { return one.first == setting; });
  return found == in_place_.end() ? nullptr : found->second;
}

std::vector<std::string> Composition::surfaces_that_read(const char *owner) const
{
  std::vector<std::string> list;
  for (const Reader &reader : readers_)
    if (!reader.surface.empty() && constants::tag(reader.owner) == constants::tag(owner))
      list.push_back(reader.surface);
  return list;
}

bool Composition::read_on_surfaces_alone(const char *owner) const
{
  return std::none_of(readers_.begin(), readers_.end(), [owner](const Reader &reader) {
    return reader.surface.empty() && constants::tag(reader.owner) == constants::tag(owner);
  });
}

bool Composition::remembers(const char *owner) const
{
  return std::any_of(memories_.begin(), memories_.end(),
                     [owner](const MemorySpec &m) { return !m.told && same_owner(m.owner, owner); });
}

std::vector<PetscScalar> Composition::constants(const Step &step) const
{
  const PetscInt blocks = constant_blocks();
  std::vector<PetscScalar> all(1, static_cast<PetscScalar>(blocks));
  PetscInt offset = 1 + 2 * blocks;
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
  for (const MemorySpec &memory : memories_) list(constants::memory_tag(memory.owner, !memory.surface.empty()), 1);
  if (!memories_.empty()) list(constants::tag(PlaceMemory::owner), 1);
  all.insert(all.end(), of_step, of_step + step_size);
  for (const ParameterBlock &block : parameters_) all.insert(all.end(), block.data, block.data + block.count);
  for (const MemorySpec &memory : memories_) all.push_back(static_cast<PetscScalar>(memory.offset));
  if (!memories_.empty()) all.push_back(constants::to_scalar<const PlaceMemory *>(nullptr));
  return all;
}

} // namespace pulmo
