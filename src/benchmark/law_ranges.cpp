// How far each tissue law goes in free inflation, as a table in Markdown: tools/law_ranges.
#include "pulmo/base/units.hpp"
#include "pulmo/physics/law_range.hpp"
#include "pulmo/physics/registry.hpp"

#include <cstdio>

namespace {

using namespace pulmo;

constexpr double pressures[] = {5, 10, 15, 20, 25}; // cmH2O: PEEP to PIP

std::string number(const char *format, double value)
{
  char text[40];
  std::snprintf(text, sizeof(text), format, value);
  return text;
}

/// J and pressure, or what stands for none.
std::string shown(const std::optional<LawRange::State> &state)
{
  if (!state) return "–";
  return number("%.3g", state->J) + " (" + number("%.3g", state->pressure / units::kPa_per_cmH2O) + ")";
}

} // namespace

int main()
{
  std::printf("| law |");
  for (double p : pressures) std::printf(" J at %g |", p);
  std::printf(" limit of pressure | of suction | softest | its dp/dJ, %% of rest | waves: below J | above J |\n|---|");
  for (std::size_t i = 0; i < std::size(pressures) + 6; ++i) std::printf("---|");
  std::printf("\n");
  for (const auto &law : Registry::standard().make_tissue_laws()) {
    const LawRange range = law_range(*law);
    const std::string alias = law->alias();
    std::printf("| `%s`%s |", law->name(), alias.empty() ? "" : (" (" + alias + ")").c_str());
    for (double p : pressures) {
      const auto J = inflated_J(*law, p * units::kPa_per_cmH2O);
      std::printf(" %s |", J ? number("%.3g", *J).c_str() : "none");
    }
    std::printf(" %s | %s | %s | %s | %s | %s |\n", shown(range.largest).c_str(), shown(range.least).c_str(),
                shown(range.softest).c_str(), range.softest ? number("%.2g", 100 * range.softest_share).c_str() : "–",
                shown(range.waves_below).c_str(), shown(range.waves_above).c_str());
  }
  return 0;
}
