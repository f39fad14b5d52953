#include "pulmo/adjoint/enrichment.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>

namespace pulmo {

namespace {

/// Degree of the rule that is exact for the determinant of displacement of degree @p k.
constexpr PetscInt exact_degree(PetscInt k)
{
  return 2 * k - 1;
}

/// Values at a node by the nodes of elements of degree 1 or 2 around it: mesh points and weights.
struct Stencil {
  std::vector<PetscInt> points;
  std::vector<PetscReal> weights;
};

/// The edge of @p dm at @p point, an edge or a face, between two vertices.
PetscErrorCode edge_between(DM dm, PetscInt point, PetscInt a, PetscInt b, PetscInt &edge)
{
  DMPolytopeType type;
  const PetscInt *cone, *ends;

  PetscFunctionBeginUser;
  edge = point;
  PetscCall(DMPlexGetCellType(dm, point, &type));
  if (type == DM_POLYTOPE_SEGMENT) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(DMPlexGetCone(dm, point, &cone));
  for (int i = 0; i < 3; ++i) {
    PetscCall(DMPlexGetCone(dm, cone[i], &ends));
    if (std::minmax(ends[0], ends[1]) == std::minmax(a, b)) edge = cone[i];
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode stencil_of(DM dm, PetscInt point, const ElementNode &node, PetscInt degree, Stencil &stencil)
{
  PetscFunctionBeginUser;
  stencil = {};
  for (PetscInt i = 0; i < node.n; ++i) {
    const PetscReal a = node.weights[i];
    stencil.points.push_back(node.vertices[i]);
    stencil.weights.push_back(degree == 1 ? a : a * (2 * a - 1));
    for (PetscInt j = 0; degree == 2 && j < i; ++j) {
      PetscInt edge;
      PetscCall(edge_between(dm, point, node.vertices[i], node.vertices[j], edge));
      stencil.points.push_back(edge);
      stencil.weights.push_back(4 * a * node.weights[j]);
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace

PetscErrorCode Enrichment::setup(Model &model)
{
  Composition composition = model.composition().enriched(field_);
  const PetscInt exact = exact_degree(composition.elements().displacement_degree);
  const PetscInt for_pressure = 2 * composition.elements().pressure_degree - 1;

  PetscFunctionBeginUser;
  run_ = &model;
  // for a richer pressure no more than it takes: else what the run has solved would not be solved here
  rich_.integrate_to(std::max(model.quadrature_degree(), field_ == displacement ? exact : for_pressure));
  PetscCall(rich_.build(std::move(composition), model.modulus()));
  for (VecHandle *v : {&x_, &rate_, &diagonal_, &stiffness_, &work_, &other_}) {
    PetscCall(DMCreateLocalVector(rich_.dm(), v->out()));
    PetscCall(VecZeroEntries(*v));
  }
  PetscCall(DMCreateGlobalVector(rich_.dm(), global_.out()));
  PetscCall(DMCreateLocalVector(model.dm(), run_work_.out()));
  PetscCall(DMCreateGlobalVector(model.dm(), run_global_.out()));
  PetscCall(find_nodes());
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// How the values at each node follow from those of the run's elements, and which functions are new.
PetscErrorCode Enrichment::find_nodes()
{
  PetscSection rich, run;
  PetscInt begin, end, size;
  std::vector<ElementNode> nodes;
  Stencil stencil;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(rich_.dm(), &rich));
  PetscCall(DMGetLocalSection(run_->dm(), &run));
  PetscCall(PetscSectionGetChart(rich, &begin, &end));
  PetscCall(PetscSectionGetStorageSize(rich, &size));
  function_of_.assign(static_cast<std::size_t>(size), 0);
  const auto &fields = run_->composition().fields();
  for (PetscInt f = 0; f < static_cast<PetscInt>(fields.size()); ++f) {
    const PetscInt components = fields[f].components;
    for (PetscInt p = begin; p < end; ++p) {
      PetscInt dofs, offset, from, there;
      PetscCall(PetscSectionGetFieldDof(rich, p, f, &dofs));
      if (dofs == 0) continue;
      PetscCall(PetscSectionGetFieldOffset(rich, p, f, &offset));
      PetscCall(PetscSectionGetFieldDof(run, p, f, &there));
      const PetscInt n = dofs / components;
      const bool same = there == dofs;
      PetscCall(nodes_at(rich_.dm(), p, n, nodes));
      for (PetscInt i = 0; i < n; ++i) {
        if (same)
          stencil = {{p}, {1}};
        else
          PetscCall(stencil_of(rich_.dm(), p, nodes[i], fields[f].degree, stencil));
        nodes_.push_back({offset + i * components, static_cast<PetscInt>(stencil.points.size()),
                          static_cast<PetscInt>(sources_.size()), components});
        for (std::size_t s = 0; s < stencil.points.size(); ++s) {
          PetscCall(PetscSectionGetFieldOffset(run, stencil.points[s], f, &from));
          sources_.push_back(same ? from + i * components : from);
          source_weights_.push_back(stencil.weights[s]);
        }
      }
      if (same) continue;
      functions_.push_back({offset, n == 2 ? offset + components : -1});
      const auto number = static_cast<PetscInt>(functions_.size());
      for (PetscInt c = 0; c < components; ++c) {
        function_of_[offset + c] = number;
        if (n == 2) function_of_[offset + components + c] = -number;
      }
    }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Enrichment::interpolate(Vec run, Vec rich) const
{
  PetscFunctionBeginUser;
  const ReadArray from(run);
  WriteArray to(rich);
  for (const Node &node : nodes_)
    for (PetscInt c = 0; c < node.components; ++c) {
      PetscScalar sum = 0;
      for (PetscInt s = node.from; s < node.from + node.n; ++s) sum += source_weights_[s] * from[sources_[s] + c];
      to[node.dof + c] = sum;
    }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Enrichment::sum_up(Vec local, bool held)
{
  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(global_));
  PetscCall(DMLocalToGlobal(rich_.dm(), local, ADD_VALUES, global_));
  PetscCall(VecZeroEntries(local));
  PetscCall(DMGlobalToLocal(rich_.dm(), global_, INSERT_VALUES, local));
  if (held) PetscCall(rich_.airway().fill(local, 0));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Enrichment::weigh(const StageRecord &record, Mat matrix)
{
  const bool gas = field_ == pressure;
  std::vector<std::unique_ptr<ReadArray>> z;
  std::vector<std::unique_ptr<WriteArray>> y;

  PetscFunctionBeginUser;
  if (gas) { // the tissue gives way to a pressure: what it does stands beside the flow
    PetscCall(MatGetDiagonal(matrix, run_global_));
    PetscCall(VecZeroEntries(run_work_));
    PetscCall(DMGlobalToLocal(run_->dm(), run_global_, INSERT_VALUES, run_work_));
    PetscCall(interpolate(run_work_, stiffness_));
  }
  for (std::size_t k = 0; k < z_.size(); ++k) {
    z.push_back(std::make_unique<ReadArray>(z_[k]));
    y.push_back(std::make_unique<WriteArray>(weights_[k]));
  }
  PetscCall(VecZeroEntries(diagonal_));
  WriteArray diagonal(diagonal_);
  const ReadArray stiffness(stiffness_);
  const CellLayout &layout = rich_.assembly().layout();
  blocks_.clear();
  block_places_.clear();
  block_entries_.clear();
  const auto take = [&](PetscInt cell, const PetscScalar *entries) -> PetscErrorCode {
    const PetscInt *dofs = layout.cell_dofs(cell), n = layout.size;
    if (!gas) keep_block(dofs, entries);
    const auto scale = [&](PetscInt i) { return rich_.row_scale(layout.field_of[i]); };
    for (PetscInt j = 0; j < n; ++j) {
      const PetscInt function = function_of_[dofs[j]];
      if (function == 0) continue;
      const Function &f = functions_[static_cast<std::size_t>(std::abs(function)) - 1];
      const PetscReal sign = function > 0 ? 1 : -1;
      // its first node with this component, and the other
      const PetscInt place = function > 0 ? dofs[j] : dofs[j] - (f.other - f.dof),
                     partner = f.other >= 0 ? place + f.other - f.dof : -1;
      for (PetscInt i = 0; i < n; ++i) {
        const PetscScalar entry = scale(i) * entries[i * n + j];
        if (entry == 0) continue;
        for (std::size_t k = 0; k < z.size(); ++k) (*y[k])[place] += sign * entry * (*z[k])[dofs[i]];
        if (dofs[i] == place) diagonal[place] += sign * entry;
        if (dofs[i] == partner) diagonal[place] -= sign * entry;
        if (gas && layout.field_of[i] == displacement && stiffness[dofs[i]] > 0)
          diagonal[place] -= entry * scale(j) * entries[j * n + i] / stiffness[dofs[i]];
      }
    }
    return PETSC_SUCCESS;
  };
  PetscCall(rich_.cell_matrices(record.time, x_, rate_, record.stage.slope, take));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Enrichment::add_at_functions(Vec local, Vec sum) const
{
  PetscFunctionBeginUser;
  const ReadArray direct(local);
  WriteArray y(sum);
  for (const Function &f : functions_)
    for (PetscInt c = 0; c < components(); ++c)
      y[f.dof + c] += direct[f.dof + c] - (f.other >= 0 ? direct[f.other + c] : 0);
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Enrichment::keep_block(const PetscInt *dofs, const PetscScalar *entries)
{
  const CellLayout &layout = rich_.assembly().layout();
  const PetscInt n = layout.size;
  // of each function, counted in the cell; the second: -1, or where it is minus one
  std::vector<std::array<PetscInt, 2>> nodes;
  for (PetscInt i = 0; i < n; ++i) {
    const PetscInt function = function_of_[dofs[i]];
    if (function <= 0) continue;
    const Function &f = functions_[static_cast<std::size_t>(function) - 1];
    const PetscInt partner = f.other >= 0 ? dofs[i] + f.other - f.dof : -1;
    const PetscInt *there = std::find(dofs, dofs + n, partner);
    nodes.push_back({i, there < dofs + n ? static_cast<PetscInt>(there - dofs) : -1});
  }
  blocks_.push_back({static_cast<PetscInt>(nodes.size()), block_places_.size(), block_entries_.size()});
  for (const auto &column : nodes) {
    block_places_.push_back(dofs[column[0]]);
    for (const auto &row : nodes) {
      PetscReal sum = 0;
      for (int a = 0; a < 2; ++a)
        for (int b = 0; b < 2; ++b)
          if (row[a] >= 0 && column[b] >= 0) sum += (a == b ? 1 : -1) * entries[row[a] * n + column[b]];
      block_entries_.push_back(static_cast<float>(rich_.row_scale(displacement) * sum));
    }
  }
}

PetscErrorCode Enrichment::apply_blocks(Vec x, Vec y)
{
  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(work_));
  PetscCall(DMGlobalToLocal(rich_.dm(), x, INSERT_VALUES, work_));
  PetscCall(VecZeroEntries(other_));
  {
    const ReadArray from(work_);
    WriteArray to(other_);
    for (const Block &b : blocks_) {
      const PetscInt *places = block_places_.data() + b.places;
      const float *entries = block_entries_.data() + b.entries;
      for (PetscInt i = 0; i < b.size; ++i)
        for (PetscInt j = 0; j < b.size; ++j) to[places[i]] += entries[i * b.size + j] * from[places[j]];
    }
  }
  PetscCall(VecZeroEntries(y));
  PetscCall(DMLocalToGlobal(rich_.dm(), other_, ADD_VALUES, y));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Enrichment::solve_blocks(Vec weights)
{
  constexpr PetscReal enough = 0.01; // of what is left: the estimate is worth no more
  constexpr int most = 30;
  PetscReal before, start;

  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(global_));
  PetscCall(DMLocalToGlobal(rich_.dm(), weights, INSERT_VALUES, left_));
  PetscCall(VecScale(left_, -1));
  PetscCall(VecPointwiseMult(direction_, inverse_, left_));
  PetscCall(VecDot(left_, direction_, &before));
  start = before;
  for (int i = 0; i < most && before > enough * enough * start; ++i) {
    PetscReal along, now;
    PetscCall(apply_blocks(direction_, product_));
    PetscCall(VecDot(direction_, product_, &along));
    if (along <= 0) { // unstable in this direction: what was found before
      if (i == 0) PetscCall(VecCopy(direction_, global_));
      break;
    }
    PetscCall(VecAXPY(global_, before / along, direction_));
    PetscCall(VecAXPY(left_, -before / along, product_));
    PetscCall(VecPointwiseMult(product_, inverse_, left_));
    PetscCall(VecDot(left_, product_, &now));
    PetscCall(VecAYPX(direction_, now / before, product_));
    before = now;
  }
  PetscCall(VecZeroEntries(weights));
  PetscCall(DMGlobalToLocal(rich_.dm(), global_, INSERT_VALUES, weights));
  WriteArray z(weights);
  for (const Function &f : functions_)
    for (PetscInt c = 0; f.other >= 0 && c < components(); ++c) z[f.other + c] = -z[f.dof + c];
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Enrichment::solve()
{
  PetscFunctionBeginUser;
  PetscCall(sum_up(diagonal_, false));
  if (field_ == displacement) {
    for (VecHandle *v : {&inverse_, &left_, &direction_, &product_})
      if (!*v) PetscCall(VecDuplicate(global_, v->out()));
    PetscCall(VecZeroEntries(work_));
    {
      const ReadArray diagonal(diagonal_);
      WriteArray inverse(work_);
      for (const Function &f : functions_)
        for (PetscInt c = 0; c < components(); ++c) {
          const PetscReal d = diagonal[f.dof + c];
          inverse[f.dof + c] = d > 0 ? 1 / d : 0; // not positive: unstable there, or prescribed
        }
    }
    PetscCall(DMLocalToGlobal(rich_.dm(), work_, INSERT_VALUES, inverse_));
    for (VecHandle &weight : weights_) PetscCall(solve_blocks(weight));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  const ReadArray diagonal(diagonal_);
  for (VecHandle &weight : weights_) {
    WriteArray z(weight);
    for (const Function &f : functions_)
      for (PetscInt c = 0; c < components(); ++c) {
        const PetscReal d = diagonal[f.dof + c];
        z[f.dof + c] = d > 0 ? -z[f.dof + c] / d : 0; // not positive: unstable there, or prescribed
        if (f.other >= 0) z[f.other + c] = -z[f.dof + c];
      }
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Enrichment::add(const Sweep::Solved &stage, const std::vector<Later> &later,
                               const std::vector<Past> &past, Mat matrix, ByCell &sums, ByCell *left)
{
  const StageRecord &record = stage.record;
  const bool held = record.airway.mode != Airway::Mode::free && field_ == pressure;
  const std::size_t count = stage.adjoint.size();
  std::vector<Vec> both; // multipliers of the new functions, then those of the run
  ByCell parts;

  PetscFunctionBeginUser;
  while (z_.size() < count)
    for (std::vector<VecHandle> *list : {&z_, &weights_}) {
      list->emplace_back();
      PetscCall(VecDuplicate(x_, list->back().out()));
    }
  PetscCall(interpolate(stage.state, x_));
  PetscCall(interpolate(stage.rate, rate_));
  rich_.set_load(record.load);
  rich_.airway().hold(record.airway.mode != Airway::Mode::free);
  PetscCall(rich_.set_step(record.stage, record.airway.pressure, record.airway.flow));
  for (std::size_t k = 0; k < count; ++k) {
    PetscCall(interpolate(stage.adjoint[k], z_[k]));
    PetscCall(VecZeroEntries(weights_[k]));
  }
  PetscCall(weigh(record, matrix));
  for (std::size_t k = 0; k < count; ++k) {
    // what the number and later stages want of the new functions themselves
    PetscCall(VecZeroEntries(work_));
    if (field_ == displacement) {
      if (stage.by_volume[k] != 0) PetscCall(rich_.add_volume_gradient(x_, nullptr, stage.by_volume[k], work_));
      if (const auto &part = stage.of_part[k]; part.by_volume != 0)
        PetscCall(rich_.add_volume_gradient(x_, nullptr, part.by_volume, work_, part.cells));
      for (const Later &l : later) {
        PetscCall(interpolate(l.adjoint[k], other_));
        PetscCall(rich_.add_volume_gradient(x_, other_, l.factor, work_));
      }
    } else if (stage.by_mean_pressure[k] != 0) {
      PetscCall(rich_.airway().add_mean_gradient(stage.by_mean_pressure[k], work_));
    }
    PetscCall(add_at_functions(work_, weights_[k]));
    PetscCall(sum_up(weights_[k], held));
  }
  PetscCall(solve());
  for (VecHandle &weight : weights_) both.push_back(weight);
  for (std::size_t k = 0; left && k < count; ++k) {
    if (held) { // there the residual is the flux
      PetscCall(VecCopy(stage.adjoint[k], run_work_));
      PetscCall(run_->airway().fill(run_work_, 0));
      PetscCall(interpolate(run_work_, z_[k]));
    }
    both.push_back(z_[k]);
  }
  const auto take = [&](PetscReal factor) {
    for (std::size_t k = 0; k < both.size(); ++k)
      for (std::size_t c = 0; c < parts[k].size(); ++c)
        (k < count ? sums[k] : (*left)[k - count])[c] += factor * parts[k][c];
  };
  PetscCall(rich_.weighted_residual(false, record.time, x_, rate_, both, parts));
  take(1);
  for (const Past &p : past) {
    PetscCall(interpolate(p.state, x_));
    PetscCall(rich_.weighted_volume(x_, both, parts));
    take(p.factor);
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
