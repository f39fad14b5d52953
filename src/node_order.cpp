#include "pulmo/node_order.hpp"

#include "pulmo/mesh.hpp"

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <tuple>

namespace pulmo {

namespace {

struct Key {
  std::int64_t depth;  ///< 0: vertex, 1: edge
  double x[3];         ///< mm
  std::uint64_t cells; ///< of the cells around it

  auto tie() const { return std::tie(depth, x[0], x[1], x[2], cells); }
};

/// Scrambles 64 bits (splitmix64).
std::uint64_t scramble(std::uint64_t h)
{
  h += 0x9e3779b97f4a7c15U;
  h = (h ^ (h >> 30)) * 0xbf58476d1ce4e5b9U;
  h = (h ^ (h >> 27)) * 0x94d049bb133111ebU;
  return h ^ (h >> 31);
}

std::uint64_t hash(const double x[3])
{
  std::uint64_t h = 0;
  for (int d = 0; d < 3; ++d) {
    const double value = x[d] + 0.0; // -0 is 0
    std::uint64_t bits;
    std::memcpy(&bits, &value, sizeof(bits));
    h = scramble(h ^ bits);
  }
  return h;
}

/// For each mesh point a number made of the corners of all cells around it, complete on the rank that owns the point.
PetscErrorCode hash_cells(DM dm, std::vector<std::uint64_t> &around)
{
  PetscInt end, cell_begin, cell_end, vertex_begin, vertex_end, roots;
  PetscSF sf;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm, nullptr, &end));
  PetscCall(DMPlexGetHeightStratum(dm, 0, &cell_begin, &cell_end));
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  around.assign(static_cast<std::size_t>(end), 0);
  for (PetscInt c = cell_begin; c < cell_end; ++c) {
    PetscInt *closure = nullptr, n;
    std::uint64_t corners = 0;
    PetscCall(DMPlexGetTransitiveClosure(dm, c, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < n; ++i) {
      PetscReal x[3];
      if (closure[2 * i] < vertex_begin || closure[2 * i] >= vertex_end) continue;
      PetscCall(node_coordinates(dm, closure[2 * i], x));
      corners += hash(x);
    }
    for (PetscInt i = 0; i < n; ++i) around[closure[2 * i]] ^= scramble(corners);
    PetscCall(DMPlexRestoreTransitiveClosure(dm, c, PETSC_TRUE, &n, &closure));
  }
  PetscCall(DMGetPointSF(dm, &sf));
  PetscCall(PetscSFGetGraph(sf, &roots, nullptr, nullptr, nullptr));
  if (roots < 0) PetscFunctionReturn(PETSC_SUCCESS); // one rank
  for (const int shift : {0, 32}) {                  // PetscSF has bitwise operations for int
    std::vector<int> sent(around.size()), sum(around.size());
    for (std::size_t p = 0; p < around.size(); ++p) sent[p] = static_cast<int>(around[p] >> shift);
    sum = sent;
    PetscCall(PetscSFReduceBegin(sf, MPI_INT, sent.data(), sum.data(), MPI_BXOR));
    PetscCall(PetscSFReduceEnd(sf, MPI_INT, sent.data(), sum.data(), MPI_BXOR));
    for (std::size_t p = 0; p < around.size(); ++p)
      around[p] ^= static_cast<std::uint64_t>(static_cast<std::uint32_t>(sent[p]) ^ static_cast<std::uint32_t>(sum[p]))
                   << shift;
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// On rank 0: where the entries of each rank begin.
std::vector<PetscMPIInt> starts(const std::vector<PetscMPIInt> &counts)
{
  std::vector<PetscMPIInt> offsets(counts.size());
  std::exclusive_scan(counts.begin(), counts.end(), offsets.begin(), 0);
  return offsets;
}

} // namespace

PetscErrorCode owned_nodes(DM dm, std::vector<PetscInt> &nodes)
{
  PetscInt end, roots, n_leaves;
  const PetscInt *leaves;
  PetscSF sf;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm, nullptr, &end));
  PetscCall(DMGetPointSF(dm, &sf));
  PetscCall(PetscSFGetGraph(sf, &roots, &n_leaves, &leaves, nullptr));
  std::vector<char> foreign(static_cast<std::size_t>(end), 0);
  for (PetscInt i = 0; roots >= 0 && i < n_leaves; ++i) foreign[leaves ? leaves[i] : i] = 1;
  nodes.clear();
  for (PetscInt depth = 0; depth < 2; ++depth) {
    PetscInt a, b;
    PetscCall(DMPlexGetDepthStratum(dm, depth, &a, &b));
    for (PetscInt p = a; p < b; ++p)
      if (!foreign[p]) nodes.push_back(p);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode NodeOrder::setup(DM dm)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscInt vertex_begin, vertex_end;
  PetscMPIInt rank, size, n;
  std::vector<std::uint64_t> around;
  std::vector<Key> mine, all;
  MPI_Datatype key_type;
  bool distinct = true;

  PetscFunctionBeginUser;
  dm_ = dm;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscCall(owned_nodes(dm, nodes_));
  PetscCall(hash_cells(dm, around));
  PetscCall(DMPlexGetDepthStratum(dm, 0, &vertex_begin, &vertex_end));
  for (const PetscInt p : nodes_) {
    Key key{p < vertex_begin || p >= vertex_end, {0, 0, 0}, around[p]};
    PetscCall(node_coordinates(dm, p, key.x));
    mine.push_back(key);
  }
  std::vector<PetscMPIInt> counts(rank == 0 ? size : 0);
  PetscCall(PetscMPIIntCast(static_cast<PetscInt>(mine.size()), &n));
  PetscCallMPI(MPI_Gather(&n, 1, MPI_INT, counts.data(), 1, MPI_INT, 0, comm));
  const std::vector<PetscMPIInt> offsets = starts(counts);
  if (rank == 0) all.resize(static_cast<std::size_t>(offsets.back()) + static_cast<std::size_t>(counts.back()));
  PetscCallMPI(MPI_Type_contiguous(sizeof(Key), MPI_BYTE, &key_type));
  PetscCallMPI(MPI_Type_commit(&key_type));
  PetscCallMPI(MPI_Gatherv(mine.data(), n, key_type, all.data(), counts.data(), offsets.data(), key_type, 0, comm));
  PetscCallMPI(MPI_Type_free(&key_type));
  if (rank == 0) {
    std::vector<std::size_t> order(all.size());
    std::iota(order.begin(), order.end(), 0);
    std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return all[a].tie() < all[b].tie(); });
    place_.resize(all.size());
    std::uint64_t whole = 0;
    n_vertices_ = 0;
    for (std::size_t i = 0; i < order.size(); ++i) {
      const Key &key = all[order[i]];
      place_[order[i]] = i;
      n_vertices_ += key.depth == 0;
      whole = scramble(whole ^ hash(key.x) ^ key.cells);
      if (i > 0 && key.tie() == all[order[i - 1]].tie()) distinct = false;
    }
    char text[128];
    std::snprintf(text, sizeof(text), "%zu vertices, %zu edges, hash %016llx", n_vertices_, all.size() - n_vertices_,
                  static_cast<unsigned long long>(whole));
    identity_ = text;
  }
  PetscCall(from_root(comm, distinct));
  PulmoUserCheck(distinct, comm,
                 "the mesh has the same cell twice: no checkpoint can tell its nodes apart; remove one");
  PetscCall(from_root(comm, identity_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode NodeOrder::count(PetscInt field, PetscInt &components, std::vector<PetscMPIInt> &counts,
                                std::vector<PetscMPIInt> &offsets) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  PetscSection section;
  PetscInt n = 0;
  PetscMPIInt rank, size, values;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscCall(DMGetLocalSection(dm_, &section));
  PetscCall(PetscSectionGetFieldComponents(section, field, &components));
  for (const PetscInt p : nodes_) {
    PetscInt dof;
    PetscCall(PetscSectionGetFieldDof(section, p, field, &dof));
    n += dof;
  }
  PetscCall(PetscMPIIntCast(n, &values));
  counts.assign(rank == 0 ? size : 0, 0);
  PetscCallMPI(MPI_Gather(&values, 1, MPI_INT, counts.data(), 1, MPI_INT, 0, comm));
  offsets = starts(counts);
  PetscFunctionReturn(PETSC_SUCCESS);
}

template <class Copy>
void NodeOrder::each_node(PetscInt components, std::size_t n_values, Copy copy) const
{
  const auto width = static_cast<std::size_t>(components);
  const bool vertices_only = n_values == n_vertices_ * width;
  std::size_t gathered = 0;
  for (const std::size_t place : place_) {
    if (vertices_only && place >= n_vertices_) continue;
    copy(width * gathered++, width * place);
  }
}

PetscErrorCode NodeOrder::gather(PetscInt field, Vec local, std::vector<double> &values) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  PetscSection section;
  PetscInt components;
  std::vector<PetscMPIInt> counts, offsets;
  std::vector<double> mine, all;

  PetscFunctionBeginUser;
  PetscCall(count(field, components, counts, offsets));
  PetscCall(DMGetLocalSection(dm_, &section));
  {
    const ReadArray x(local);
    for (const PetscInt p : nodes_) {
      PetscInt dof, offset;
      PetscCall(PetscSectionGetFieldDof(section, p, field, &dof));
      PetscCall(PetscSectionGetFieldOffset(section, p, field, &offset));
      mine.insert(mine.end(), x.data() + offset, x.data() + offset + dof);
    }
  }
  if (!counts.empty()) all.resize(static_cast<std::size_t>(offsets.back()) + static_cast<std::size_t>(counts.back()));
  PetscCallMPI(MPI_Gatherv(mine.data(), static_cast<PetscMPIInt>(mine.size()), MPI_DOUBLE, all.data(), counts.data(),
                           offsets.data(), MPI_DOUBLE, 0, comm));
  values.resize(all.size());
  each_node(components, all.size(), [&](std::size_t gathered, std::size_t ordered) {
    std::copy_n(&all[gathered], components, &values[ordered]);
  });
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode NodeOrder::scatter(PetscInt field, const std::vector<double> &values, Vec local, bool &fits) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  PetscSection section;
  PetscSF sf;
  PetscInt components, end, roots;
  std::vector<PetscMPIInt> counts, offsets;
  std::vector<double> mine, all(values.size());
  PetscMPIInt rank;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCall(count(field, components, counts, offsets));
  fits =
      rank != 0 || values.size() == static_cast<std::size_t>(offsets.back()) + static_cast<std::size_t>(counts.back());
  PetscCall(from_root(comm, fits));
  if (!fits) PetscFunctionReturn(PETSC_SUCCESS);
  each_node(components, all.size(), [&](std::size_t gathered, std::size_t ordered) {
    std::copy_n(&values[ordered], components, &all[gathered]);
  });
  PetscCall(DMPlexGetChart(dm_, nullptr, &end));
  PetscCall(DMGetLocalSection(dm_, &section));
  PetscCall(DMGetPointSF(dm_, &sf));
  PetscCall(PetscSFGetGraph(sf, &roots, nullptr, nullptr, nullptr));
  std::vector<PetscInt> place(static_cast<std::size_t>(end), -1); // [mesh point]: first entry in the local vector
  std::size_t n = 0;
  for (PetscInt p = 0; p < end; ++p) {
    PetscInt dof, offset;
    PetscCall(PetscSectionGetFieldDof(section, p, field, &dof));
    PetscCall(PetscSectionGetFieldOffset(section, p, field, &offset));
    if (dof > 0) place[p] = offset;
  }
  for (const PetscInt p : nodes_) n += place[p] >= 0 ? static_cast<std::size_t>(components) : 0;
  mine.resize(n);
  PetscCallMPI(MPI_Scatterv(all.data(), counts.data(), offsets.data(), MPI_DOUBLE, mine.data(),
                            static_cast<PetscMPIInt>(n), MPI_DOUBLE, 0, comm));
  WriteArray x(local);
  for (PetscInt c = 0; c < components; ++c) { // owned values, then those of other ranks' nodes
    std::vector<double> owned(static_cast<std::size_t>(end), 0);
    n = 0;
    for (const PetscInt p : nodes_)
      if (place[p] >= 0) owned[p] = mine[static_cast<std::size_t>(components) * n++ + static_cast<std::size_t>(c)];
    std::vector<double> known = owned;
    if (roots >= 0) {
      PetscCall(PetscSFBcastBegin(sf, MPI_DOUBLE, owned.data(), known.data(), MPI_REPLACE));
      PetscCall(PetscSFBcastEnd(sf, MPI_DOUBLE, owned.data(), known.data(), MPI_REPLACE));
    }
    for (PetscInt p = 0; p < end; ++p)
      if (place[p] >= 0) x[place[p] + c] = known[p];
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
