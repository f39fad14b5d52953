/// @file
/// Effect `airway_tree`: branches between the airway opening and the surfaces open to it.
///
/// A branch b carries the flow q_b of all that hangs on it; its pressure falls by
///
///   p_parent - p_b = R_b(q_b) q_b,   R = 128 mu L / (pi d^4)   (Poiseuille)
///
/// times max(1, 1.85 / (4 sqrt 2) sqrt(Re d / L)) for the entrance of the flow (Pedley, Schroter & Sudlow 1970, after
/// Pedley, Sudlow & Schroter 1971), with Re = 4 rho |q| / (pi mu d). Or R is given. At the far end of a branch its wall
/// may store the gas C p_b, so that q_b is what leaves there plus C dp_b/dt. A branch that ends at a surface of the
/// lung gives it one pressure; the gas that enters the lung there is its consistent flux. Where nothing resists, all
/// surfaces have the pressure of the opening.
#pragma once

#include "pulmo/base/units.hpp"
#include "pulmo/input/csv.hpp"
#include "pulmo/mesh/mesh.hpp"
#include "pulmo/physics/effect.hpp"

#include <algorithm>
#include <cctype>
#include <cmath>

namespace pulmo {

/// A branch of the tree; kPa, mm, s.
struct AirwayBranch {
  std::string name;
  std::ptrdiff_t parent = -1;             ///< -1: the airway opening
  PetscReal resistance = 0;               ///< of laminar flow, kPa s/mm^3
  PetscReal entrance = 0;                 ///< the factor is max(1, entrance sqrt |q|), sqrt(s/mm^3)
  PetscReal compliance = 0;               ///< of the wall, mm^3/kPa
  std::vector<SurfacePart> surfaces = {}; ///< that it ends at
  PetscReal length = 0, diameter = 0;     ///< 0: its resistance is given
  PetscReal factor(PetscReal q) const { return std::max<PetscReal>(1, entrance * std::sqrt(std::abs(q))); }
  /// Fall of the pressure along it at flow @p q, mm^3/s, and the derivative of that.
  PetscReal drop(PetscReal q) const { return resistance * factor(q) * q; }
  PetscReal slope(PetscReal q) const { return resistance * factor(q) * (factor(q) > 1 ? 1.5 : 1); }
};

/// The equations of a tree whose branches are listed with parents first.
class AirwayNetwork {
public:
  explicit AirwayNetwork(std::vector<AirwayBranch> branches) : branches_(std::move(branches)) {}
  const std::vector<AirwayBranch> &branches() const { return branches_; }
  std::vector<AirwayBranch> &branches() { return branches_; }

  /// Flow that enters each branch, mm^3/s.
  std::vector<PetscReal> flows(const ScalarState &s) const
  {
    std::vector<PetscReal> q(branches_.size());
    for (std::size_t b = branches_.size(); b-- > 0;) {
      q[b] += s.flow[b] + branches_[b].compliance * s.rate[b];
      if (branches_[b].parent >= 0) q[static_cast<std::size_t>(branches_[b].parent)] += q[b];
    }
    return q;
  }

  /// 0 = p_parent - p_b - drop(q_b).
  void equations(const ScalarState &s, ScalarRows &rows) const
  {
    const std::vector<PetscReal> q = flows(s);
    for (std::size_t b = 0; b < branches_.size(); ++b) {
      const AirwayBranch &branch = branches_[b];
      const bool first = branch.parent < 0;
      const auto parent = static_cast<std::size_t>(std::max<std::ptrdiff_t>(branch.parent, 0));
      rows.value[b] = (first ? s.opening : s.value[parent]) - s.value[b] - branch.drop(q[b]);
      rows.by_value(b, b) = -1;
      if (first)
        rows.by_opening[b] = 1;
      else
        rows.by_value(b, parent) = 1;
    }
    // the flow of a branch hangs on all that hang on it
    for (std::size_t k = 0; k < branches_.size(); ++k)
      for (auto b = static_cast<std::ptrdiff_t>(k); b >= 0; b = branches_[static_cast<std::size_t>(b)].parent) {
        const auto row = static_cast<std::size_t>(b);
        rows.by_flow(row, k) = -branches_[row].slope(q[row]);
        rows.by_rate(row, k) = branches_[k].compliance * rows.by_flow(row, k);
      }
  }

  /// Energy in a step, kPa mm^3: what resistance takes, what walls store, and what backward Euler loses at them.
  PetscReal resistive(const ScalarState &now, PetscReal dt) const
  {
    const std::vector<PetscReal> q = flows(now);
    PetscReal sum = 0;
    for (std::size_t b = 0; b < branches_.size(); ++b) sum += branches_[b].drop(q[b]) * q[b] * dt;
    return sum;
  }
  PetscReal stored(const ScalarState &now, const ScalarState &before) const
  {
    PetscReal sum = 0;
    for (std::size_t b = 0; b < branches_.size(); ++b)
      sum += branches_[b].compliance * (now.value[b] * now.value[b] - before.value[b] * before.value[b]) / 2;
    return sum;
  }
  PetscReal lost(const ScalarState &now, const ScalarState &before) const
  {
    PetscReal sum = 0;
    for (std::size_t b = 0; b < branches_.size(); ++b) {
      const PetscReal rise = now.value[b] - before.value[b];
      sum += branches_[b].compliance * rise * rise / 2;
    }
    return sum;
  }

private:
  std::vector<AirwayBranch> branches_;
};

class AirwayTree final : public Effect {
public:
  const char *name() const override { return "airway_tree"; }
  const char *about() const override
  {
    return "branching airways that resist the flow to each surface (Pedley, Schroter & Sudlow 1970)";
  }
  std::string describe(const SceneFacts &) const override
  {
    const auto &branches = network_->branches();
    const auto ends =
        std::count_if(branches.begin(), branches.end(), [](const AirwayBranch &b) { return !b.surfaces.empty(); });
    return std::string(about()) + ", branches: " + std::to_string(branches.size()) +
           ", that end at the lung: " + std::to_string(ends);
  }
  const char *absence() const override
  {
    return "no airways between the opening and the lung: nothing resists there, and all open surfaces have one "
           "pressure";
  }
  std::string example() const override { return "-airway_tree star -airway_tree_resistance 5"; }
  bool active() const override { return !file_.empty() && file_ != "off"; }

  PetscErrorCode declare(Options &options) override
  {
    PetscFunctionBeginUser;
    options.group(name(), about());
    PetscCall(options.text(
        "",
        "table of branches (CSV: name, parent, length_mm, diameter_mm or "
        "resistance_cmH2O_s_per_l, compliance_ml_per_cmH2O, surface, region; docs/effects/airway_tree.md), "
        "or 'star': one branch from the opening to each surface; or 'off'",
        file_));
    options.group(name(), "star", file_ == "star", "-airway_tree star");
    PetscCall(options.real("resistance", "cmH2O s/l", Range::not_negative(), "of each branch", resistance_));
    options.group(name(), "table of branches", active() && file_ != "star", "-airway_tree FILE");
    PetscCall(options.real("viscosity", "Pa s", Range::positive(), "of the gas (air at 37 C: 1.8e-5)", viscosity_));
    PetscCall(options.real("density", "kg/m^3", Range::not_negative(),
                           "of the gas; 0: no more resistance than that of laminar flow", density_));
    if (active() && file_ != "star") {
      PetscCall(Csv::read(options.comm(), "-airway_tree", file_,
                          {"name", "parent", "length_mm", "diameter_mm", "resistance_cmH2O_s_per_l",
                           "compliance_ml_per_cmH2O", "surface", "region"},
                          table_));
      options.note_content("-airway_tree", "a table, " + table_.hash());
    }
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode announce(SceneFacts &facts) override
  {
    facts.surface_pressures_by = name();
    return PETSC_SUCCESS;
  }

  PetscErrorCode check(const Options &options, const Mesh &mesh, const SceneFacts &facts) override
  {
    const MPI_Comm comm = options.comm();
    std::vector<Mesh::Region> regions;
    std::vector<AirwayBranch> branches;

    PetscFunctionBeginUser;
    PulmoUserCheck(facts.ventilator, comm, "-airway_tree needs a -ventilator at its opening");
    PulmoUserCheck(facts.airflow, comm,
                   "-airway_tree needs -airflow: without it all gas has one pressure, and no branch a flow of its own");
    PulmoUserCheck(facts.flow_split != FlowSplit::uniform, comm,
                   "-ventilator_flow_split uniform shares the flow by area, -airway_tree by resistance; leave one out");
    if (file_ == "star")
      for (const std::string &surface : facts.airway_surfaces) {
        branches.push_back({surface, -1, 0, 0, 0, {{surface, ""}}});
        set_resistance(branches.back());
      }
    else
      PetscCall(read_branches(comm, branches));
    PetscCall(mesh.regions(regions));
    for (const AirwayBranch &branch : branches)
      for (const SurfacePart &part : branch.surfaces) {
        PulmoUserCheck(std::find(facts.airway_surfaces.begin(), facts.airway_surfaces.end(), part.surface) !=
                           facts.airway_surfaces.end(),
                       comm,
                       "-airway_tree: branch '%s' ends at surface '%s', which is not open; name it in "
                       "-airflow_surfaces",
                       branch.name.c_str(), part.surface.c_str());
        const bool known = part.region.empty() || std::any_of(regions.begin(), regions.end(),
                                                              [&](const auto &r) { return r.name == part.region; });
        std::string names;
        for (const auto &r : regions) names += (names.empty() ? "" : ", ") + r.name;
        PulmoUserCheck(known, comm,
                       "-airway_tree: branch '%s' ends in '%s', and the mesh has no volume of that name; it has: %s",
                       branch.name.c_str(), part.region.c_str(), names.c_str());
      }
    network_ = std::make_shared<AirwayNetwork>(std::move(branches));
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode terms(Composition &c, const SceneFacts &) const override
  {
    std::vector<ScalarSpec> list;
    for (const AirwayBranch &branch : network_->branches())
      list.push_back({branch.name, branch.surfaces, branch.compliance});
    const auto equations = [this](const ScalarState &s, ScalarRows &rows) {
      for (AirwayBranch &branch : network_->branches()) set_resistance(branch);
      network_->equations(s, rows);
    };
    if (file_ == "star")
      c.scalars(list, equations, {&resistance_});
    else
      c.scalars(list, equations, {&viscosity_, &density_});
    c.scalar_energy(
        Energy::dissipated, "resistive_airways",
        [n = network_](const ScalarState &now, const ScalarState &, PetscReal dt) { return n->resistive(now, dt); });
    c.scalar_energy(Energy::stored, "elastic_airways",
                    [n = network_](const ScalarState &now, const ScalarState &before, PetscReal) {
                      return n->stored(now, before);
                    });
    c.scalar_energy(
        Energy::numerical, "numerical_dissipation",
        [n = network_](const ScalarState &now, const ScalarState &before, PetscReal) { return n->lost(now, before); });
    return PETSC_SUCCESS;
  }

private:
  static constexpr PetscReal mm3_per_l = 1000 * units::mm3_per_ml;
  static constexpr const char *opening = "opening"; ///< as a parent in the table; so is an empty cell

  static bool is_word(const std::string &text)
  {
    return std::all_of(text.begin(), text.end(), [](unsigned char c) {
      return (c < 128 && std::isalnum(c)) || c == '_' || c == '-' || c == '.';
    });
  }

  /// Resistance of a branch by the settings as they are now, where the table does not give it.
  void set_resistance(AirwayBranch &branch) const
  {
    constexpr PetscReal kPa_per_Pa = 1e-3, mm_per_m = 1e3;
    const PetscReal length = branch.length, diameter = branch.diameter;
    if (file_ == "star") branch.resistance = resistance_ * units::kPa_per_cmH2O / mm3_per_l;
    if (length == 0) return;
    const PetscReal mu = viscosity_ * kPa_per_Pa,                 // kPa s
        rho = density_ * kPa_per_Pa / (mm_per_m * mm_per_m),      // kPa s^2/mm^2
        reynolds_per_flow = 4 * rho / (PETSC_PI * mu * diameter); // s/mm^3
    branch.resistance = 128 * mu * length / (PETSC_PI * std::pow(diameter, 4));
    branch.entrance = 1.85 / (4 * std::sqrt(2.0)) * std::sqrt(reynolds_per_flow * diameter / length);
  }

  /// The branches of the table, parents first.
  PetscErrorCode read_branches(MPI_Comm comm, std::vector<AirwayBranch> &branches) const
  {
    std::vector<bool> placed(table_.rows(), false);
    std::map<std::string, std::ptrdiff_t> number = {{opening, -1}, {"", -1}};

    PetscFunctionBeginUser;
    for (std::size_t row = 0; row < table_.rows(); ++row) {
      const std::string &own = table_.cell(row, "name"), where = table_.where(row);
      bool twice = false, bears = false;
      PulmoUserCheck(!own.empty() && own != opening && is_word(own), comm,
                     "%s: a branch needs a name, one word of letters, digits, '_', '-' and '.', and not '%s'",
                     where.c_str(), opening);
      for (std::size_t other = 0; other < table_.rows(); ++other) {
        twice = twice || (other != row && table_.cell(other, "name") == own);
        bears = bears || table_.cell(other, "parent") == own;
      }
      PulmoUserCheck(!twice, comm, "%s: two branches are named '%s'; give each a name of its own", where.c_str(),
                     own.c_str());
      PulmoUserCheck(bears != !table_.cell(row, "surface").empty(), comm,
                     "%s: branch '%s' must end either at other branches (their 'parent') or at a 'surface'",
                     where.c_str(), own.c_str());
    }
    for (bool more = true; more;) {
      more = false;
      for (std::size_t row = 0; row < table_.rows(); ++row) {
        const auto parent = number.find(table_.cell(row, "parent"));
        if (placed[row] || parent == number.end()) continue;
        AirwayBranch branch;
        PetscCall(read_branch(comm, row, branch));
        branch.parent = parent->second;
        number[branch.name] = static_cast<std::ptrdiff_t>(branches.size());
        branches.push_back(branch);
        placed[row] = more = true;
      }
    }
    for (std::size_t row = 0; row < table_.rows(); ++row)
      PulmoUserCheck(placed[row], comm, "%s: branch '%s' does not lead to the opening: its parent '%s' is %s",
                     table_.where(row).c_str(), table_.cell(row, "name").c_str(), table_.cell(row, "parent").c_str(),
                     "not in the table, or hangs on it");
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  PetscErrorCode read_branch(MPI_Comm comm, std::size_t row, AirwayBranch &branch) const
  {
    std::optional<PetscReal> length, diameter, resistance, compliance;

    PetscFunctionBeginUser;
    branch.name = table_.cell(row, "name");
    PetscCall(table_.number(row, "length_mm", Range::positive(), length));
    PetscCall(table_.number(row, "diameter_mm", Range::positive(), diameter));
    PetscCall(table_.number(row, "resistance_cmH2O_s_per_l", Range::not_negative(), resistance));
    PetscCall(table_.number(row, "compliance_ml_per_cmH2O", Range::not_negative(), compliance));
    PulmoUserCheck(resistance ? !length && !diameter : length && diameter, comm,
                   "%s: branch '%s' needs length_mm and diameter_mm, or resistance_cmH2O_s_per_l alone",
                   table_.where(row).c_str(), branch.name.c_str());
    if (resistance)
      branch.resistance = *resistance * units::kPa_per_cmH2O / mm3_per_l;
    else
      branch.length = *length, branch.diameter = *diameter;
    branch.compliance = compliance.value_or(0) * units::mm3_per_ml / units::kPa_per_cmH2O;
    set_resistance(branch);
    PulmoUserCheck(std::isfinite(branch.resistance + branch.entrance + branch.compliance), comm,
                   "%s: branch '%s' has a resistance or compliance that is no finite number; check its sizes and their "
                   "units",
                   table_.where(row).c_str(), branch.name.c_str());
    if (!table_.cell(row, "surface").empty())
      branch.surfaces = {{table_.cell(row, "surface"), table_.cell(row, "region")}};
    PetscFunctionReturn(PETSC_SUCCESS);
  }

  std::string file_;
  Csv table_;
  PetscReal resistance_ = 0, viscosity_ = 1.8e-5, density_ = 1.2;
  std::shared_ptr<AirwayNetwork> network_;
};

} // namespace pulmo
