#include "pulmo/fem/model.hpp"

#include "pulmo/fem/pattern.hpp"
#include "pulmo/fem/point_memory.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/mesh/shared_points.hpp"
#include "pulmo/physics/parameter_fields.hpp"

#include <algorithm>
#include <cstring>
#include <set>

namespace pulmo {

Model::Model() = default;
Model::~Model() = default;

PetscErrorCode Model::declare(Options &options, const Elements &elements)
{
  const PetscInt k = elements.displacement_degree;

  PetscFunctionBeginUser;
  quadrature_degree_ = 2 * k - 1;
  options.group("quadrature", "integration (-petscfe_type pulmo|basic chooses the integrator)");
  PetscCall(
      options.whole("degree", "-", Range::between(std::max<PetscReal>(1, 2 * k - 2), 8),
                    "degree of the rule in the cells (2 k - 1 for displacement of degree k: for P2 8 points, exact "
                    "for det F; 4: 14 points, for checks)",
                    quadrature_degree_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::build(Composition composition, PetscReal modulus)
{
  PetscFunctionBeginUser;
  mesh_ = &composition.mesh();
  composition_ = std::make_unique<Composition>(std::move(composition));
  modulus_ = modulus;
  PetscCall(this->composition().check_parameters(PetscObjectComm((PetscObject)mesh_->dm())));
  PetscCall(DMClone(mesh_->dm(), dm_.out()));
  PetscCall(create_fields());
  PetscCall(create_weak_form());
  PetscCall(create_section());
  PetscDS rate_ds = nullptr;
  if (!own_) {
    PetscCall(create_stock());
    PetscCall(DMGetDS(rate_dm_, &rate_ds));
  }
  PetscCall(assembly_.setup(dm_, rate_ds, this->composition().varying()));
  row_scale_.assign(this->composition().fields().size(), 1);
  PetscCall(set_step(1, 0));
  if (this->composition().needs_air()) {
    std::vector<PetscReal> airless_J;
    for (PetscInt c = 0; c < assembly_.cells(); ++c)
      airless_J.push_back(constants::get<Porosity>(constants_at(c)).least_J());
    assembly_.need_air(std::move(airless_J));
  }
  if (this->composition().memories().empty()) PetscFunctionReturn(PETSC_SUCCESS);
  memory_ = std::make_unique<PointMemory>();
  PetscCall(memory_->setup(*this));
  PetscCall(assembly_.remember(*memory_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// For PETSc's own loops over cells: a DM with the volume terms only (PETSc 3.18 has wrong gradients on facets, see
/// Assembly) and an auxiliary field of the same discretisation that carries the rates.
PetscErrorCode Model::create_stock()
{
  PetscSection section;
  PetscDS ds;

  PetscFunctionBeginUser;
  PetscCall(DMGetLocalSection(dm_, &section));
  for (DMHandle *dm : {&stock_dm_, &rate_dm_}) {
    PetscCall(DMClone(mesh_->dm(), dm->out()));
    PetscCall(compat::copy_fields(dm_, *dm));
    PetscCall(DMCreateDS(*dm));
    PetscCall(DMSetLocalSection(*dm, section));
  }
  PetscCall(DMGetDS(stock_dm_, &ds));
  PetscCall(add_volume_terms(ds));
  PetscCall(DMCreateLocalVector(rate_dm_, rate_.out()));
  PetscCall(DMSetAuxiliaryVec(stock_dm_, nullptr, 0, 0, rate_));
  PetscCall(DMCreateGlobalVector(dm_, scale_.out()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::add_volume_terms(PetscDS ds) const
{
  PetscWeakForm wf;

  PetscFunctionBeginUser;
  PetscCall(PetscDSGetWeakForm(ds, &wf));
  for (const Term &t : composition().terms()) {
    if (!t.surface.empty()) continue;
    if (t.trial < 0)
      PetscCall(PetscWeakFormAddResidual(wf, nullptr, 0, t.test, 0, t.f0, t.f1));
    else
      PetscCall(PetscWeakFormAddJacobian(wf, nullptr, 0, t.test, t.trial, 0, t.g0, t.g1, t.g2, t.g3));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::create_fields()
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);
  QuadratureHandle rule, face_rule;
  PetscFE first = nullptr;
  PetscBool own;

  PetscFunctionBeginUser;
  PetscCall(PetscDTSimplexQuadrature(3, quadrature_degree_, PETSCDTSIMPLEXQUAD_MINSYM, rule.out()));
  PetscCall(PetscDTSimplexQuadrature(2, std::max<PetscInt>(4, quadrature_degree_), PETSCDTSIMPLEXQUAD_MINSYM,
                                     face_rule.out()));
  PetscInt index = 0;
  for (const FieldSpec &field : composition().fields()) {
    FEHandle fe;
    PetscCall(PetscFECreateLagrange(comm, 3, field.components, PETSC_TRUE, field.degree, PETSC_DETERMINE, fe.out()));
    PetscCall(PetscObjectSetName((PetscObject)(PetscFE)fe, field.name.c_str()));
    if (!first) {
      PetscCall(PetscFESetQuadrature(fe, rule));
      PetscCall(PetscFESetFaceQuadrature(fe, face_rule));
      first = fe;
    } else {
      PetscCall(PetscFECopyQuadrature(first, fe));
    }
    PetscCall(PetscFESetType(fe, "pulmo"));
    PetscCall(PetscFESetFromOptions(fe));
    PetscCall(PetscObjectTypeCompare((PetscObject)(PetscFE)fe, "pulmo", &own));
    own_ = own;
    PulmoUserCheck(own_ || quadrature_degree_ > 1, comm,
                   "-petscfe_type basic: PETSc has no room for the points of facets where cells have one; give "
                   "-quadrature_degree 2 or leave basic out");
    PetscCall(DMSetField(dm_, index++, nullptr, (PetscObject)(PetscFE)fe));
    if (index == 1) PetscCall(DMGetField(dm_, 0, nullptr, (PetscObject *)&first));
  }
  PetscCall(DMCreateDS(dm_));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::create_weak_form()
{
  PetscDS ds;
  std::map<std::pair<std::string, PetscInt>, PetscWeakForm> boundary; // of each surface and test field

  PetscFunctionBeginUser;
  PetscCall(DMGetDS(dm_, &ds));
  PetscCall(add_volume_terms(ds));
  for (const Term &term : composition().terms()) {
    if (term.surface.empty()) continue;
    DMLabel label;
    const PetscInt value = mesh_->surface(term.surface).value;
    PetscCall(DMGetLabel(dm_, term.surface.c_str(), &label));
    PetscWeakForm &wf = boundary[{term.surface, term.test}];
    if (!wf) {
      PetscInt bd;
      PetscCall(DMAddBoundary(dm_, DM_BC_NATURAL, term.surface.c_str(), label, 1, &value, term.test, 0, nullptr,
                              nullptr, nullptr, nullptr, &bd));
      PetscCall(PetscDSGetBoundary(ds, bd, &wf, nullptr, nullptr, nullptr, nullptr, nullptr, nullptr, nullptr, nullptr,
                                   nullptr, nullptr, nullptr));
    }
    if (term.trial < 0)
      PetscCall(PetscWeakFormAddBdResidual(wf, label, value, term.test, 0, term.bd_f0, term.bd_f1));
    else
      PetscCall(PetscWeakFormAddBdJacobian(wf, label, value, term.test, term.trial, 0, term.bd_g0, term.bd_g1,
                                           term.bd_g2, term.bd_g3));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::find_holders(Holders &holders)
{
  PetscInt end;
  std::vector<PetscInt> facets;

  PetscFunctionBeginUser;
  PetscCall(DMPlexGetChart(dm_, nullptr, &end));
  for (std::vector<PetscInt> *list : holders.all()) list->assign(static_cast<std::size_t>(end), -1);
  const auto &constraints = composition().constraints();
  for (std::size_t k = 0; k < constraints.size(); ++k) {
    const Constraint &constraint = constraints[k];
    const auto hold = [&](PetscInt point) {
      for (std::size_t c = 0; c < 3; ++c)
        if (constraint.component[c])
          (constraint.field == displacement ? holders.displacement[c]
           : constraint.at_airway           ? holders.airway
                                            : holders.pressure)[point] = static_cast<PetscInt>(k);
    };
    for (PetscInt vertex : constraint.vertices) hold(vertex);
    if (constraint.surface.empty()) continue;
    PetscCall(mesh_->facets(constraint.surface, facets));
    for (PetscInt facet : facets) {
      PetscInt *closure = nullptr, n_closure;
      PetscCall(DMPlexGetTransitiveClosure(dm_, facet, PETSC_TRUE, &n_closure, &closure));
      for (PetscInt j = 0; j < n_closure; ++j) hold(closure[2 * j]);
      PetscCall(DMPlexRestoreTransitiveClosure(dm_, facet, PETSC_TRUE, &n_closure, &closure));
    }
  }
  // an edge or vertex of a surface may be on a rank that has none of the surface's facets
  for (std::vector<PetscInt> *list : holders.all()) PetscCall(combine_shared(dm_, MPI_MAX, *list));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::create_section()
{
  const auto &fields = composition().fields();
  const auto n_fields = static_cast<PetscInt>(fields.size());
  Holders holders;
  std::vector<PetscInt> components, dofs, bc_field;
  std::vector<DMLabel> labels(fields.size(), nullptr);
  std::vector<ISHandle> owned;
  std::vector<IS> bc_components, bc_points;
  PetscInt begin, end;
  SectionHandle section;

  PetscFunctionBeginUser;
  PetscCall(find_holders(holders));
  PetscCall(DMPlexGetChart(dm_, &begin, &end));
  for (PetscInt f = 0; f < n_fields; ++f) {
    PetscFE fe;
    const PetscInt *per_depth;
    PetscCall(DMGetField(dm_, f, nullptr, (PetscObject *)&fe));
    PetscCall(PetscFEGetNumDof(fe, &per_depth));
    components.push_back(fields[f].components);
    dofs.insert(dofs.end(), per_depth, per_depth + 4);
  }
  // group the constrained points by field and set of components: no point is in two groups of a field
  std::map<std::pair<PetscInt, int>, std::vector<PetscInt>> groups;
  for (PetscInt p = begin; p < end; ++p) {
    int set = 0;
    for (int c = 0; c < 3; ++c)
      if (holders.displacement[c][p] >= 0) set |= 1 << c;
    if (set) groups[{displacement, set}].push_back(p);
    if (holders.pressure[p] >= 0 && n_fields > pressure) groups[{pressure, 1}].push_back(p);
  }
  // every rank passes the same groups in the same order
  for (PetscInt f = 0; f < std::min<PetscInt>(n_fields, 2); ++f)
    for (int set = 1; set < (f == displacement ? 8 : 2); ++set) {
      const auto &points = groups[{f, set}];
      std::vector<PetscInt> which;
      for (int c = 0; c < 3; ++c)
        if (set & (1 << c)) which.push_back(c);
      owned.emplace_back();
      PetscCall(ISCreateGeneral(PETSC_COMM_SELF, (PetscInt)which.size(), which.data(), PETSC_COPY_VALUES,
                                owned.back().out()));
      bc_components.push_back(owned.back());
      owned.emplace_back();
      PetscCall(ISCreateGeneral(PETSC_COMM_SELF, (PetscInt)points.size(), points.data(), PETSC_COPY_VALUES,
                                owned.back().out()));
      bc_points.push_back(owned.back());
      bc_field.push_back(f);
    }
  PetscCall(DMPlexCreateSection(dm_, labels.data(), components.data(), dofs.data(), (PetscInt)bc_field.size(),
                                bc_field.data(), bc_components.data(), bc_points.data(), nullptr, section.out()));
  for (PetscInt f = 0; f < n_fields; ++f) PetscCall(PetscSectionSetFieldName(section, f, fields[f].name.c_str()));
  if (composition().common_gas_pressure()) {
    PulmoUserCheck(
        own_, PetscObjectComm((PetscObject)(DM)dm_),
        "-petscfe_type basic cannot carry the unknown gas pressure of a flow phase, of a tube or past a limit point "
        "without -airflow; use the default, pulmo");
    PetscCall(airway_.add_rows(dm_, 1, components[displacement], section));
  }
  PetscCall(add_symmetries(section));
  PetscCall(DMSetLocalSection(dm_, section));

  prescribed_.clear();
  std::vector<std::array<PetscReal, 3>> x;
  for (PetscInt p = begin; p < end; ++p) {
    for (PetscInt c = 0; c < 4; ++c) {
      const PetscInt k = c < 3 ? holders.displacement[c][p] : holders.pressure[p], f = c < 3 ? displacement : pressure;
      PetscInt dof, offset;
      if (k < 0 || f >= n_fields) continue;
      PetscCall(PetscSectionGetFieldDof(section, p, f, &dof));
      if (dof == 0) continue;
      PetscCall(PetscSectionGetFieldOffset(section, p, f, &offset));
      PetscCall(node_coordinates(dm_, p, dof / components[f], x));
      for (std::size_t node = 0; node < x.size(); ++node) {
        Prescribed value{};
        value.component = static_cast<std::int16_t>(c < 3 ? c : 0);
        value.dof = offset + static_cast<PetscInt>(node) * components[f] + value.component;
        value.constraint = static_cast<std::int16_t>(k);
        std::copy(x[node].begin(), x[node].end(), value.x);
        prescribed_.push_back(value);
      }
    }
  }
  PetscCall(find_airway(holders));
  PetscInt n_known;
  IS *rows;
  PetscCall(DMCreateFieldIS(dm_, &n_known, nullptr, &rows));
  field_rows_.resize(static_cast<std::size_t>(n_known));
  for (PetscInt f = 0; f < n_known; ++f) *field_rows_[f].out() = rows[f];
  PetscCall(PetscFree(rows));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// Where an edge has two nodes, cells see them in the order of their own corners.
PetscErrorCode Model::add_symmetries(PetscSection section) const
{
  DMHandle plain;
  PetscSection known;

  PetscFunctionBeginUser;
  if (composition().elements().displacement_degree < 3) PetscFunctionReturn(PETSC_SUCCESS);
  PetscCall(DMClone(mesh_->dm(), plain.out())); // PETSc knows them for the sections that it makes
  PetscCall(compat::copy_fields(dm_, plain));
  PetscCall(DMCreateDS(plain));
  PetscCall(DMGetLocalSection(plain, &known));
  for (std::size_t f = 0; f < composition().fields().size(); ++f) {
    PetscSectionSym symmetries;
    PetscCall(PetscSectionGetFieldSym(known, static_cast<PetscInt>(f), &symmetries));
    PetscCall(PetscSectionSetFieldSym(section, static_cast<PetscInt>(f), symmetries));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::find_airway(const Holders &holders)
{
  std::vector<AirwayNodes::Group> groups;
  std::set<std::string> surfaces; // open, and no scalar of an effect is their pressure
  std::vector<bool> held_as_airway(holders.airway.size());
  PetscInt scalar = 1; // after the pressure at the opening

  PetscFunctionBeginUser;
  for (const Constraint &c : composition().constraints())
    if (c.at_airway) surfaces.insert(c.surface);
  const std::vector<std::string> open(surfaces.begin(), surfaces.end());
  closes_rows_ = !surfaces.empty() || composition().common_gas_pressure();
  for (const ScalarGroup &group : composition().scalar_groups())
    for (const ScalarSpec &spec : group.scalars) {
      if (!spec.surfaces.empty()) groups.push_back({spec.name, spec.surfaces, scalar});
      for (const SurfacePart &part : spec.surfaces) surfaces.erase(part.surface);
      ++scalar;
    }
  AirwayNodes::Group rest; // at the pressure of the opening
  for (const std::string &surface : surfaces) rest.surfaces.push_back({surface, ""});
  if (!rest.surfaces.empty()) groups.push_back(rest);
  for (std::size_t p = 0; p < held_as_airway.size(); ++p)
    held_as_airway[p] = holders.airway[p] >= 0 && holders.pressure[p] < 0;
  PetscCall(
      airway_.setup(dm_, *mesh_, composition().elements(), groups, open, held_as_airway, closes_rows_ ? scalar : 0));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::set_step(const Stage &stage, PetscReal airway_pressure, PetscReal airway_flow)
{
  const PetscReal L = mesh_->length();

  PetscFunctionBeginUser;
  const PetscReal load = step_.load;
  step_ = Step(stage, airway_pressure, airway_.area() > 0 ? -airway_flow / airway_.area() : 0);
  step_.load = load;
  airway_.set_pressure(airway_pressure);
  row_scale_[displacement] = 1 / (modulus_ * L * L);
  if (row_scale_.size() > pressure) row_scale_[pressure] = (stage.slope > 0 ? 1 / stage.slope : stage.dt) / (L * L * L);
  PetscCall(pack_constants());
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::pack_constants()
{
  PetscDS ds;

  PetscFunctionBeginUser;
  constants_ = composition().constants(step_);
  if (change_.by != 0) {
    for (const PetscInt place : change_.places) constants_[static_cast<std::size_t>(place)] += change_.by;
    for (const DerivedParameter &derived : composition().derived()) {
      const char *owner;
      const PetscInt place = composition().constant_at(derived.target, &owner);
      constants_[static_cast<std::size_t>(place)] = derived.value(constants_);
    }
  }
  const auto n = static_cast<PetscInt>(constants_.size());
  PetscCall(DMGetDS(dm_, &ds));
  PetscCall(PetscDSSetConstants(ds, n, constants_.data()));
  if (stock_dm_) {
    PetscCall(DMGetDS(stock_dm_, &ds));
    PetscCall(PetscDSSetConstants(ds, n, constants_.data()));
  }
  PetscFunctionReturn(PETSC_SUCCESS);
}

const PetscScalar *Model::constants_at(PetscInt cell, const std::string &surface) const
{
  const ParameterFields *varying = composition().varying();
  if (!varying) return constants_.data();
  local_constants_ = constants_;
  varying->patch(cell, surface, local_constants_);
  for (const PetscInt place : change_.places) // over which the place's own was written
    if (std::find(varying->offsets().begin(), varying->offsets().end(), place) != varying->offsets().end())
      local_constants_[static_cast<std::size_t>(place)] += change_.by;
  return local_constants_.data();
}

PetscErrorCode Model::constrain(PetscReal t, Vec local) const
{
  PetscFunctionBeginUser;
  WriteArray x(local);
  for (const Prescribed &p : prescribed_) {
    PetscScalar value[3] = {0, 0, 0};
    composition().constraints()[p.constraint].value(t, p.x, value);
    x[p.dof] = value[p.component];
  }
  airway_.constrain(x);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::constrain_rate(Vec local, Vec before, PetscReal dt, Vec rate) const
{
  PetscFunctionBeginUser;
  const ReadArray now(local), then(before);
  WriteArray r(rate);
  for (const Prescribed &p : prescribed_) r[p.dof] = (now[p.dof] - then[p.dof]) / dt;
  airway_.constrain_rate(now, then, dt, r);
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::residual_sums(Vec F, ResidualSums &sums) const
{
  PetscInt first;

  PetscFunctionBeginUser;
  sums.absolute.assign(field_rows_.size(), 0);
  sums.net.assign(field_rows_.size(), 0);
  PetscCall(VecGetOwnershipRange(F, &first, nullptr));
  {
    const ReadArray f(F);
    for (std::size_t field = 0; field < field_rows_.size(); ++field) {
      const PetscInt *rows;
      PetscInt n;
      PetscCall(ISGetLocalSize(field_rows_[field], &n));
      PetscCall(ISGetIndices(field_rows_[field], &rows));
      for (PetscInt i = 0; i < n; ++i) {
        const PetscReal value = f[rows[i] - first] / row_scale_[field];
        sums.absolute[field] += std::abs(value);
        sums.net[field] += value;
      }
      PetscCall(ISRestoreIndices(field_rows_[field], &rows));
    }
  }
  for (std::vector<PetscReal> *sum : {&sums.absolute, &sums.net})
    PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, sum->data(), static_cast<PetscMPIInt>(sum->size()), MPIU_REAL, MPI_SUM,
                               PetscObjectComm((PetscObject)F)));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::loads(PetscReal t, Vec local, Vec F, PetscReal &force, PetscReal &gas)
{
  PetscSection section;
  PetscInt begin, end;
  Vec rest, zero, local_loads, loads;
  ResidualSums sums;
  PetscReal borne[2] = {0, 0}; // by field

  PetscFunctionBeginUser;
  {
    const ReadArray f(F);
    for (const Prescribed &p : prescribed_) {
      const PetscInt field = composition().constraints()[p.constraint].field;
      borne[field] += std::abs(f[p.dof]) / row_scale_[field];
    }
  }
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, borne, 2, MPIU_REAL, MPI_SUM, PetscObjectComm((PetscObject)(DM)dm_)));
  for (Vec *v : {&rest, &zero, &local_loads}) PetscCall(DMGetLocalVector(dm_, v));
  PetscCall(DMGetGlobalVector(dm_, &loads));
  PetscCall(VecZeroEntries(zero));
  PetscCall(VecCopy(local, rest));
  PetscCall(DMGetLocalSection(dm_, &section));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  {
    WriteArray x(rest);
    for (PetscInt p = begin; p < end; ++p) {
      PetscInt dofs, offset;
      PetscCall(PetscSectionGetFieldDof(section, p, displacement, &dofs));
      PetscCall(PetscSectionGetFieldOffset(section, p, displacement, &offset));
      std::fill_n(x.data() + offset, dofs, 0);
    }
  }
  const auto sum_at = [&](Vec state) -> PetscErrorCode {
    PetscFunctionBeginUser;
    PetscCall(residual(t, state, zero, local_loads));
    PetscCall(VecZeroEntries(loads));
    PetscCall(DMLocalToGlobal(dm_, local_loads, ADD_VALUES, loads));
    PetscCall(residual_sums(loads, sums));
    PetscFunctionReturn(PETSC_SUCCESS);
  };
  PetscCall(sum_at(rest));
  force = sums.absolute[displacement] + borne[displacement];
  gas = 0;
  if (sums.absolute.size() > pressure) {
    PetscCall(sum_at(zero));
    gas = sums.absolute[pressure] + borne[pressure];
  }
  PetscCall(DMRestoreGlobalVector(dm_, &loads));
  for (Vec *v : {&rest, &zero, &local_loads}) PetscCall(DMRestoreLocalVector(dm_, v));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::residual(PetscReal t, Vec x, Vec x_t, Vec F)
{
  PetscFunctionBeginUser;
  PetscCall(VecZeroEntries(F));
  if (stock_loops()) PetscCall(stock_residual(t, x, x_t, F));
  PetscCall(assembly_.residual(stock_loops() ? Assembly::Part::facets : Assembly::Part::all, t, x, x_t,
                               row_scale_.data(), F));
  PetscFunctionReturn(PETSC_SUCCESS);
}

void Model::change_parameter(const std::vector<PetscInt> &places, PetscReal change)
{
  const ParameterFields *varying = composition().varying();
  const auto add = [&](PetscReal by) {
    for (std::size_t i = 0; varying && i < varying->offsets().size(); ++i)
      if (std::find(change_.places.begin(), change_.places.end(), varying->offsets()[i]) != change_.places.end())
        assembly_.change_varying(i, by);
  };
  add(-change_.by);
  change_ = {places, change};
  add(change);
}

/// PETSc's own loop over cells, then the scaling of the rows.
PetscErrorCode Model::stock_residual(PetscReal t, Vec x, Vec x_t, Vec F)
{
  PetscFunctionBeginUser;
  PetscCall(VecCopy(x_t, rate_));
  PetscCall(DMPlexTSComputeIFunctionFEM(stock_dm_, t, x, x_t, F, nullptr));
  WriteArray f(F);
  PetscSection section;
  PetscInt begin, end;
  PetscCall(DMGetLocalSection(dm_, &section));
  PetscCall(PetscSectionGetChart(section, &begin, &end));
  for (PetscInt p = begin; p < end; ++p)
    for (std::size_t field = 0; field < row_scale_.size(); ++field) {
      PetscInt dof, offset;
      PetscCall(PetscSectionGetFieldDof(section, p, (PetscInt)field, &dof));
      PetscCall(PetscSectionGetFieldOffset(section, p, (PetscInt)field, &offset));
      for (PetscInt d = 0; d < dof; ++d) f[offset + d] *= row_scale_[field];
    }
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::create_matrix(Mat *A) const
{
  PetscFunctionBeginUser;
  PetscCall(pulmo::create_matrix(dm_, A));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::jacobian(PetscReal t, Vec x, Vec x_t, PetscReal shift, Mat A)
{
  PetscFunctionBeginUser;
  if (stock_loops()) PetscCall(stock_jacobian(t, x, x_t, shift, A));
  for (CellMatrices *also : also_) PetscCall(also->begin());
  PetscCall(assembly_.jacobian(stock_loops() ? Assembly::Part::facets : Assembly::Part::all, t, x, x_t, shift,
                               row_scale_.data(), A, also_));
  for (CellMatrices *also : also_) PetscCall(also->end(airway_.closed_points()));
  if (closes_rows_) PetscCall(airway_.close_rows(A, composition().n_scalars() > 0));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::transposed_jacobian(PetscReal t, Vec x, Vec x_t, PetscReal shift, Mat A)
{
  PetscFunctionBeginUser;
  PetscCheck(!stock_loops(), PetscObjectComm((PetscObject)(DM)dm_), PETSC_ERR_SUP, "needs pulmo's own integration");
  for (CellMatrices *also : also_) PetscCall(also->begin());
  PetscCall(assembly_.transposed_jacobian(t, x, x_t, shift, row_scale_.data(), A, also_));
  for (CellMatrices *also : also_) PetscCall(also->end(airway_.closed_points()));
  PetscFunctionReturn(PETSC_SUCCESS);
}

/// The same for the Jacobian.
PetscErrorCode Model::stock_jacobian(PetscReal t, Vec x, Vec x_t, PetscReal shift, Mat A)
{
  PetscFunctionBeginUser;
  PetscCall(VecCopy(x_t, rate_));
  PetscCall(DMPlexTSComputeIJacobianFEM(stock_dm_, t, x, x_t, shift, A, A, nullptr));
  for (std::size_t field = 0; field < row_scale_.size(); ++field) {
    ISHandle rows;
    DMHandle unused;
    const auto f = static_cast<PetscInt>(field);
    PetscCall(DMCreateSubDM(dm_, 1, &f, rows.out(), unused.out()));
    PetscCall(VecISSet(scale_, rows, row_scale_[field]));
  }
  PetscCall(MatDiagonalScale(A, scale_, nullptr));
  PetscFunctionReturn(PETSC_SUCCESS);
}

PetscErrorCode Model::reactions(Vec F, std::vector<std::array<PetscReal, 3>> &forces) const
{
  const MPI_Comm comm = PetscObjectComm((PetscObject)(DM)dm_);

  PetscFunctionBeginUser;
  forces.assign(composition().constraints().size(), {0, 0, 0});
  const ReadArray f(F);
  for (const Prescribed &p : prescribed_)
    if (composition().constraints()[p.constraint].field == displacement)
      forces[p.constraint][p.component] += f[p.dof] / row_scale_[displacement];
  PetscCallMPI(MPI_Allreduce(MPI_IN_PLACE, forces.data(), 3 * (PetscMPIInt)forces.size(), MPIU_REAL, MPI_SUM, comm));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
