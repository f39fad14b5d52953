#include "pulmo/mesh/node_order.hpp"

#include "pulmo/mesh/elements.hpp"

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <tuple>

namespace pulmo {

namespace {

struct Key {
  std::int64_t depth;  ///< 0: vertex, 1: edge, 2: face
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
  PetscInt end, cell_begin, cell_end, roots;
  PetscSF sf;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm, nullptr, &end));
  PetscCall(DMPlexGetHeightStratum(dm, 0, &cell_begin, &cell_end));
  around.assign(static_cast<std::size_t>(end), 0);
  for (PetscInt c = cell_begin; c < cell_end; ++c) {
    PetscInt *closure = nullptr, n;
    std::uint64_t corners;
    PetscCall(hash_corners(dm, c, corners));
    PetscCall(DMPlexGetTransitiveClosure(dm, c, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < n; ++i) around[closure[2 * i]] ^= corners;
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

/// Up to which dimension mesh points carry nodes: 2, or 3 if faces do.
PetscErrorCode highest_dimension(DM dm, PetscInt &dimension)
{
  PetscSection section;
  PetscInt begin, end, dof, most = 0;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm, &section));
  PetscCall(DMPlexGetDepthStratum(dm, 2, &begin, &end));
  for (PetscInt p = begin; p < end; ++p) {
    PetscCall(PetscSectionGetDof(section, p, &dof));
    most = std::max(most, dof);
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, &most, 1, MPIU_INT, MPI_MAX, PetscObjectComm((PetscObject)dm)));
  dimension = most > 0 ? 3 : 2;
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The middle of a vertex, edge or face, to the last bit whatever the order of its vertices. @p reversed: an edge whose
/// second vertex comes before the first.
PetscErrorCode find_place(DM dm, PetscInt point, PetscReal x[3], bool &reversed)
{
  std::vector<ElementNode> nodes;
  std::vector<std::array<PetscReal, 3>> corners;

  PetscFunctionBeginUser;
  PetscCall(nodes_at(dm, point, 1, nodes));
  for (PetscInt i = 0; i < nodes[0].n; ++i) {
    corners.emplace_back();
    PetscCall(node_coordinates(dm, nodes[0].vertices[i], corners.back().data()));
  }
  reversed = nodes[0].n == 2 && corners[1] < corners[0];
  std::vector<PetscReal> one(corners.size());
  for (std::size_t d = 0; d < 3; ++d) {
    for (std::size_t i = 0; i < corners.size(); ++i) one[i] = corners[i][d];
    std::sort(one.begin(), one.end());
    x[d] = std::accumulate(one.begin(), one.end(), PetscReal(0)) / static_cast<PetscReal>(one.size());
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

PetscErrorCode hash_corners(DM dm, PetscInt point, std::uint64_t &h)
{
  PetscInt begin, end, n, *closure = nullptr;
  std::uint64_t sum = 0; // whatever the order of the corners

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetDepthStratum(dm, 0, &begin, &end));
  PetscCall(DMPlexGetTransitiveClosure(dm, point, PETSC_TRUE, &n, &closure));
  for (PetscInt i = 0; i < n; ++i) {
    PetscReal x[3];
    if (closure[2 * i] < begin || closure[2 * i] >= end) continue;
    PetscCall(node_coordinates(dm, closure[2 * i], x));
    sum += hash(x);
  }
  PetscCall(DMPlexRestoreTransitiveClosure(dm, point, PETSC_TRUE, &n, &closure));
  h = scramble(sum);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode owned_points(DM dm, PetscInt dimension, std::vector<PetscInt> &points)
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
  points.clear();
  for (PetscInt depth = 0; depth < dimension; ++depth) {
    PetscInt a, b;
    PetscCall(DMPlexGetDepthStratum(dm, depth, &a, &b));
    for (PetscInt p = a; p < b; ++p)
      if (!foreign[p]) points.push_back(p);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode NodeOrder::setup(DM dm)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  PetscMPIInt rank, size, n;
  PetscInt dimension = 0;
  std::vector<std::uint64_t> around;
  std::vector<Key> mine, all;
  MPI_Datatype key_type;
  bool distinct = true;

  PetscFunctionBeginUser;
  dm_ = dm;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscCall(highest_dimension(dm, dimension));
  PetscCall(owned_points(dm, dimension, points_));
  PetscCall(hash_cells(dm, around));
  for (const PetscInt p : points_) {
    PetscInt depth;
    bool reversed = false;
    PetscCall(DMPlexGetPointDepth(dm, p, &depth));
    Key key{depth, {0, 0, 0}, around[p]};
    PetscCall(find_place(dm, p, key.x, reversed));
    mine.push_back(key);
    reversed_.push_back(reversed);
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
    counts_ = {0, 0, 0};
    for (std::size_t i = 0; i < order.size(); ++i) {
      const Key &key = all[order[i]];
      place_[order[i]] = i;
      ++counts_[static_cast<std::size_t>(key.depth)];
      if (key.depth < 2) whole = scramble(whole ^ hash(key.x) ^ key.cells); // the mesh, whatever its elements
      if (i > 0 && key.tie() == all[order[i - 1]].tie()) distinct = false;
    }
    char text[128];
    std::snprintf(text, sizeof(text), "%zu vertices, %zu edges, hash %016llx", counts_[0], counts_[1],
                  static_cast<unsigned long long>(whole));
    identity_ = text;
  }
  PetscCall(from_root(comm, distinct));
  PulmoUserCheck(distinct, comm,
                 "the mesh has the same cell twice: no checkpoint can tell its nodes apart; remove one");
  PetscCall(from_root(comm, identity_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode NodeOrder::count(PetscInt field, Widths &widths, std::vector<PetscMPIInt> &counts,
                                std::vector<PetscMPIInt> &offsets) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  PetscSection section;
  PetscInt n = 0, of_kind[kinds] = {0, 0, 0};
  PetscMPIInt rank, size, values;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscCall(DMGetLocalSection(dm_, &section));
  for (const PetscInt p : points_) {
    PetscInt dof, depth;
    PetscCall(PetscSectionGetFieldDof(section, p, field, &dof));
    PetscCall(DMPlexGetPointDepth(dm_, p, &depth));
    of_kind[depth] = dof;
    n += dof;
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, of_kind, kinds, MPIU_INT, MPI_MAX, comm));
  std::copy_n(of_kind, kinds, widths.begin());
  PetscCall(PetscMPIIntCast(n, &values));
  counts.assign(rank == 0 ? size : 0, 0);
  PetscCallMPI(MPI_Gather(&values, 1, MPI_INT, counts.data(), 1, MPI_INT, 0, comm));
  offsets = starts(counts);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode NodeOrder::owned_dofs(PetscInt field, std::vector<PetscInt> &dofs) const
{
  PetscSection section;
  PetscInt components;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm_, &section));
  PetscCall(PetscSectionGetFieldComponents(section, field, &components));
  for (std::size_t i = 0; i < points_.size(); ++i) {
    PetscInt dof, offset;
    PetscCall(PetscSectionGetFieldDof(section, points_[i], field, &dof));
    PetscCall(PetscSectionGetFieldOffset(section, points_[i], field, &offset));
    for (PetscInt d = 0; d < dof; ++d) {
      const PetscInt node = d / components, last = dof / components - 1;
      dofs.push_back(offset + (reversed_[i] ? last - node : node) * components + d % components);
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

template <class Copy>
void NodeOrder::each_point(const Widths &widths, Copy copy) const
{
  std::array<std::size_t, kinds> first_place{}, first_value{}; // of each kind
  std::size_t gathered = 0;
  for (std::size_t k = 1; k < kinds; ++k) {
    first_place[k] = first_place[k - 1] + counts_[k - 1];
    first_value[k] = first_value[k - 1] + widths[k - 1] * counts_[k - 1];
  }
  for (const std::size_t place : place_) {
    std::size_t kind = kinds - 1;
    while (place < first_place[kind]) --kind;
    copy(gathered, first_value[kind] + (place - first_place[kind]) * widths[kind], widths[kind]);
    gathered += widths[kind];
  }
}

PetscErrorCode NodeOrder::gather(PetscInt field, Vec local, std::vector<double> &values) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  Widths widths;
  std::vector<PetscMPIInt> counts, offsets;
  std::vector<PetscInt> dofs;
  std::vector<double> mine, all;

  PetscFunctionBeginUser;
  PetscCall(count(field, widths, counts, offsets));
  PetscCall(owned_dofs(field, dofs));
  {
    const ReadArray x(local);
    for (const PetscInt dof : dofs) mine.push_back(x[dof]);
  }
  if (!counts.empty()) all.resize(static_cast<std::size_t>(offsets.back()) + static_cast<std::size_t>(counts.back()));
  PetscCallMPI(MPI_Gatherv(mine.data(), static_cast<PetscMPIInt>(mine.size()), MPI_DOUBLE, all.data(), counts.data(),
                           offsets.data(), MPI_DOUBLE, 0, comm));
  values.resize(all.size());
  each_point(widths, [&](std::size_t gathered, std::size_t ordered, std::size_t n) {
    std::copy_n(&all[gathered], n, &values[ordered]);
  });
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode NodeOrder::scatter(PetscInt field, const std::vector<double> &values, Vec local, bool &fits) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  PetscSection section;
  PetscSF sf;
  PetscInt end, roots;
  Widths widths;
  std::vector<PetscMPIInt> counts, offsets;
  std::vector<PetscInt> dofs;
  std::vector<double> all(values.size());
  PetscMPIInt rank;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCall(count(field, widths, counts, offsets));
  fits =
      rank != 0 || values.size() == static_cast<std::size_t>(offsets.back()) + static_cast<std::size_t>(counts.back());
  PetscCall(from_root(comm, fits));
  if (!fits) PetscFunctionReturn(PETSC_SUCCESS);
  each_point(widths, [&](std::size_t gathered, std::size_t ordered, std::size_t n) {
    std::copy_n(&values[ordered], n, &all[gathered]);
  });
  PetscCall(owned_dofs(field, dofs));
  std::vector<double> mine(dofs.size());
  PetscCallMPI(MPI_Scatterv(all.data(), counts.data(), offsets.data(), MPI_DOUBLE, mine.data(),
                            static_cast<PetscMPIInt>(mine.size()), MPI_DOUBLE, 0, comm));
  WriteArray x(local);
  for (std::size_t i = 0; i < dofs.size(); ++i) x[dofs[i]] = mine[i];

  // what other ranks own
  PetscCall(DMGetPointSF(dm_, &sf));
  PetscCall(PetscSFGetGraph(sf, &roots, nullptr, nullptr, nullptr));
  if (roots < 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(DMPlexGetChart(dm_, nullptr, &end));
  PetscCall(DMGetLocalSection(dm_, &section));
  std::vector<double> owned(static_cast<std::size_t>(end)), known(static_cast<std::size_t>(end));
  for (PetscInt d = 0; d < static_cast<PetscInt>(*std::max_element(widths.begin(), widths.end())); ++d) {
    const auto each = [&](auto &&visit) -> PetscErrorCode {
      PetscFunctionBeginUser;
      for (PetscInt p = 0; p < end; ++p) {
        PetscInt dof, offset;
        PetscCall(PetscSectionGetFieldDof(section, p, field, &dof));
        PetscCall(PetscSectionGetFieldOffset(section, p, field, &offset));
        if (d < dof) visit(p, offset + d);
      }
      PetscFunctionReturn(PETSC_SUCCESS);
    };
    PetscCall(each([&](PetscInt p, PetscInt dof) { owned[p] = x[dof]; }));
    known = owned;
    PetscCall(PetscSFBcastBegin(sf, MPI_DOUBLE, owned.data(), known.data(), MPI_REPLACE));
    PetscCall(PetscSFBcastEnd(sf, MPI_DOUBLE, owned.data(), known.data(), MPI_REPLACE));
    PetscCall(each([&](PetscInt p, PetscInt dof) { x[dof] = known[p]; }));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
