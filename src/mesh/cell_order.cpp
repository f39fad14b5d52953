#include "pulmo/mesh/cell_order.hpp"

#include "pulmo/mesh/elements.hpp"

#include <algorithm>
#include <array>
#include <numeric>

namespace pulmo {

PetscErrorCode CellOrder::find_key(DM dm, PetscInt cell, PetscInt facet, Key &key)
{
  using Corner = std::array<PetscReal, 3>;
  PetscInt begin, end;
  std::vector<Corner> corners, of_facet;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetDepthStratum(dm, 0, &begin, &end));
  const auto collect = [&](PetscInt point, std::vector<Corner> &list) -> PetscErrorCode {
    PetscInt n, *closure = nullptr;
    PetscFunctionBeginUser;
    PetscCall(DMPlexGetTransitiveClosure(dm, point, PETSC_TRUE, &n, &closure));
    for (PetscInt i = 0; i < n; ++i) {
      if (closure[2 * i] < begin || closure[2 * i] >= end) continue;
      list.emplace_back();
      PetscCall(node_coordinates(dm, closure[2 * i], list.back().data()));
    }
    PetscCall(DMPlexRestoreTransitiveClosure(dm, point, PETSC_TRUE, &n, &closure));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(collect(cell, corners));
  std::sort(corners.begin(), corners.end());
  key = {};
  for (std::size_t i = 0; i < 12; ++i) key[i] = corners[i / 3][i % 3];
  if (facet < 0) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(collect(facet, of_facet));
  const auto lacks = std::find_if(corners.begin(), corners.end(), [&](const Corner &c) {
    return std::find(of_facet.begin(), of_facet.end(), c) == of_facet.end();
  });
  key[12] = static_cast<double>(lacks - corners.begin());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode CellOrder::setup(DM dm)
{
  PetscInt begin, end;
  std::vector<Key> mine;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetHeightStratum(dm, 0, &begin, &end));
  for (PetscInt c = begin; c < end; ++c) { // cells are not shared: pulmo distributes without overlap
    mine.emplace_back();
    PetscCall(find_key(dm, c, -1, mine.back()));
  }
  PetscCall(sort(dm, mine));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode CellOrder::setup(DM dm, const std::vector<PetscInt> &facets)
{
  std::vector<Key> mine;

  PetscFunctionBeginUser;
  for (const PetscInt facet : facets) {
    const PetscInt *support;
    PetscCall(DMPlexGetSupport(dm, facet, &support));
    mine.emplace_back();
    PetscCall(find_key(dm, support[0], facet, mine.back()));
  }
  PetscCall(sort(dm, mine));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode CellOrder::sort(DM dm, const std::vector<Key> &mine)
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm);
  std::vector<Key> all;
  std::vector<PetscMPIInt> counts, starts;
  MPI_Datatype type;

  PetscFunctionBeginUser;
  dm_ = dm;
  mine_ = mine.size();
  PetscCall(layout(1, counts, starts));
  if (!counts.empty()) all.resize(static_cast<std::size_t>(starts.back()) + static_cast<std::size_t>(counts.back()));
  PetscCallMPI(MPI_Type_contiguous(static_cast<int>(std::tuple_size_v<Key>), MPI_DOUBLE, &type));
  PetscCallMPI(MPI_Type_commit(&type));
  PetscCallMPI(MPI_Gatherv(mine.data(), static_cast<PetscMPIInt>(mine.size()), type, all.data(), counts.data(),
                           starts.data(), type, 0, comm));
  PetscCallMPI(MPI_Type_free(&type));
  std::vector<std::size_t> order(all.size());
  std::iota(order.begin(), order.end(), 0);
  std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return all[a] < all[b]; });
  place_.resize(all.size());
  for (std::size_t i = 0; i < order.size(); ++i) place_[order[i]] = i;
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode CellOrder::layout(std::size_t width, std::vector<PetscMPIInt> &counts,
                                 std::vector<PetscMPIInt> &starts) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  PetscMPIInt rank, size, n;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  PetscCallMPI(MPI_Comm_size(comm, &size));
  PetscCall(PetscMPIIntCast(static_cast<PetscInt>(width * mine_), &n));
  counts.assign(rank == 0 ? size : 0, 0);
  PetscCallMPI(MPI_Gather(&n, 1, MPI_INT, counts.data(), 1, MPI_INT, 0, comm));
  starts.resize(counts.size());
  std::exclusive_scan(counts.begin(), counts.end(), starts.begin(), 0);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode CellOrder::gather(std::size_t width, const std::vector<double> &mine, std::vector<double> &all) const
{
  std::vector<PetscMPIInt> counts, starts;
  std::vector<double> gathered(width * place_.size());

  PetscFunctionBeginUser;
  PetscCall(layout(width, counts, starts));
  PetscCallMPI(MPI_Gatherv(mine.data(), static_cast<PetscMPIInt>(mine.size()), MPI_DOUBLE, gathered.data(),
                           counts.data(), starts.data(), MPI_DOUBLE, 0, PetscObjectComm((PetscObject)dm_)));
  all.resize(gathered.size());
  for (std::size_t c = 0; c < place_.size(); ++c) std::copy_n(&gathered[c * width], width, &all[place_[c] * width]);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode CellOrder::scatter(std::size_t width, const std::vector<double> &all, std::vector<double> &mine,
                                  bool &fits) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)dm_);
  PetscMPIInt rank;
  std::vector<PetscMPIInt> counts, starts;

  PetscFunctionBeginUser;
  PetscCallMPI(MPI_Comm_rank(comm, &rank));
  fits = rank != 0 || all.size() == width * place_.size();
  PetscCall(from_root(comm, fits));
  if (!fits) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(layout(width, counts, starts));
  std::vector<double> sent(all.size());
  for (std::size_t c = 0; c < place_.size(); ++c) std::copy_n(&all[place_[c] * width], width, &sent[c * width]);
  mine.resize(width * mine_);
  PetscCallMPI(MPI_Scatterv(sent.data(), counts.data(), starts.data(), MPI_DOUBLE, mine.data(),
                            static_cast<PetscMPIInt>(mine.size()), MPI_DOUBLE, 0, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
