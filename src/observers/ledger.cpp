#include "pulmo/observers/ledger.hpp"

#include "pulmo/fem/point_memory.hpp"

#include <map>

namespace pulmo {

namespace {

/// Seconds in the callbacks of each effect: what was timed, scaled up. A callback of several terms counts for the first
/// that registered it.
std::map<std::string, double> seconds_of(const Composition &composition, const IntegrationLog &log)
{
  std::map<std::string, double> spent;
  auto left = log.seconds;
  const double scale =
      log.timed_cells > 0 ? (double)(log.residual_cells + log.jacobian_cells) / (double)log.timed_cells : 0;
  const auto charge = [&](auto callback, const std::string &effect, double factor) {
    const auto entry = left.find(reinterpret_cast<void (*)(void)>(callback));
    if (!callback || entry == left.end()) return;
    spent[effect] += entry->second * factor;
    left.erase(entry);
  };

  for (const Term &t : composition.terms()) {
    for (auto f : {t.f0, t.f1}) charge(f, t.effect, scale);
    for (auto g : {t.g0, t.g1, t.g2, t.g3}) charge(g, t.effect, scale);
    for (auto f : {t.bd_f0, t.bd_f1}) charge(f, t.effect, 1);
    for (auto g : {t.bd_g0, t.bd_g1, t.bd_g2, t.bd_g3}) charge(g, t.effect, 1);
  }
  return spent;
}

} // namespace

std::vector<LedgerEntry> ledger(const Scene &scene, const Model &model)
{
  const Composition &composition = model.composition();
  const auto &fields = composition.fields();
  const std::map<std::string, double> spent = seconds_of(composition, model.assembly().log());
  std::vector<LedgerEntry> entries;

  for (const Effect *effect : scene.active()) {
    LedgerEntry entry;
    entry.effect = effect->name();
    for (const FieldSpec &f : fields)
      if (f.effect == entry.effect) entry.fields.push_back(f.name + " P" + std::to_string(f.degree));
    for (const Term &t : composition.terms()) {
      if (t.effect != entry.effect) continue;
      const std::string where = t.surface.empty() ? "" : " on " + t.surface;
      entry.terms.push_back(t.name + where +
                            (t.trial < 0 ? "  (row " + fields[t.test].name + ")"
                                         : "  [" + fields[t.test].name + ", " + fields[t.trial].name + "]"));
    }
    for (const Constraint &c : composition.constraints())
      if (c.effect == entry.effect)
        entry.terms.push_back(c.name + " prescribed" + (c.surface.empty() ? " at vertices" : " on " + c.surface) +
                              "  (" + fields[c.field].name + ")");
    for (const MemorySpec &m : composition.memories()) {
      if (m.effect != entry.effect) continue;
      entry.bytes += model.memory()->bytes(m);
      entry.terms.push_back("remembers " + std::to_string(m.quantities.size()) + " quantities at each point of " +
                            (m.surface.empty() ? "a cell" : "a facet of " + m.surface) + " (" +
                            std::to_string(model.memory()->bytes(m)) + " bytes on this rank)");
    }
    for (const ScalarGroup &group : composition.scalar_groups()) {
      if (group.effect != entry.effect) continue;
      for (const ScalarSpec &s : group.scalars)
        entry.terms.push_back(
            "unknown pressure " + s.name +
            (s.surfaces.empty() ? "" : " on " + s.surfaces.front().text() + " (one more solve a Newton step)"));
    }
    if (const auto found = spent.find(entry.effect); found != spent.end()) entry.seconds = found->second;
    entries.push_back(entry);
  }
  return entries;
}

PetscErrorCode print_ledger(MPI_Comm comm, const Scene &scene, const Model &model, const StageSeconds &seconds)
{
  const IntegrationLog &log = model.assembly().log();
  const auto per_cell = [](auto calls, auto cells) { return cells > 0 ? (double)calls / (double)cells : 0; };
  double timed = 0;

  PetscFunctionBeginUser;
  PetscCall(PetscPrintf(
      comm, "\nEffects of this scene (seconds in its terms; one block of cells in %d is timed)\n%-16s %-22s %-9s %s\n",
      (int)Assembly::timed_share, "effect", "fields", "seconds", "share of run, terms, blocks"));
  for (const LedgerEntry &entry : ledger(scene, model)) {
    std::string fields, terms;
    for (const std::string &field : entry.fields) fields += (fields.empty() ? "" : ", ") + field;
    for (const std::string &term : entry.terms) terms += "\n    " + term;
    timed += entry.seconds;
    PetscCall(PetscPrintf(comm, "%-16s %-22s %9.4f %5.1f %%%s\n", entry.effect.c_str(),
                          fields.empty() ? "-" : fields.c_str(), entry.seconds,
                          seconds.total > 0 ? 100 * entry.seconds / seconds.total : 0, terms.c_str()));
  }
  PetscCall(PetscPrintf(
      comm,
      "callbacks per cell: residual %.0f, Jacobian %.0f; run: setup %.3f s, residual %.3f s, Jacobian %.3f s, "
      "solve %.3f s, output %.3f s (callbacks above %.3f s)\n",
      per_cell(log.residual_calls, log.residual_cells), per_cell(log.jacobian_calls, log.jacobian_cells), seconds.setup,
      seconds.residual, seconds.jacobian, seconds.solve, seconds.output, timed));
  PetscFunctionReturn(PETSC_SUCCESS);
}

} // namespace pulmo
