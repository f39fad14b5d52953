#include "pulmo/input/replay_file.hpp"

#include <nlohmann/json.hpp>

#include <algorithm>
#include <array>
#include <cctype>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>

namespace pulmo {

namespace {

namespace fs = std::filesystem;

/// Raise it when a name or a meaning changes.
constexpr int format = 1;
/// Larger files are none of these, bytes.
constexpr std::size_t largest_file = 16U << 20;

/// All digits; JSON itself has no infinity.
std::string exact(double number)
{
  std::array<char, 40> text{};
  (void)std::snprintf(text.data(), text.size(), "%.17g", number);
  return text.data();
}

} // namespace

NamedValues rounding_environment()
{
  NamedValues list;
  for (const char *name : {"OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENBLAS_CORETYPE", "MKL_NUM_THREADS"})
    if (const char *value = std::getenv(name)) list.emplace_back(name, value);
  return list;
}

std::string hash_of_file(const std::string &file)
{
  std::ifstream in(file, std::ios::binary);
  std::vector<char> block(1U << 16);
  std::uint64_t hash = 14695981039346656037U, bytes = 0; // FNV-1a
  if (!in.is_open()) return "";
  while (in.read(block.data(), static_cast<std::streamsize>(block.size())) || in.gcount() > 0) {
    for (std::streamsize i = 0; i < in.gcount(); ++i)
      hash = (hash ^ static_cast<unsigned char>(block[static_cast<std::size_t>(i)])) * 1099511628211U;
    bytes += static_cast<std::uint64_t>(in.gcount());
  }
  if (in.bad()) return "";
  std::array<char, 64> text{};
  (void)std::snprintf(text.data(), text.size(), "%llu bytes, hash %016llx", static_cast<unsigned long long>(bytes),
                      static_cast<unsigned long long>(hash));
  return text.data();
}

std::string ReplayFile::text() const
{
  using Json = nlohmann::ordered_json;
  Json json = {
      {"format", format},        {"version", version},     {"petsc", petsc},         {"ranks", ranks},
      {"directory", directory},  {"mesh", mesh},           {"mesh_hash", mesh_hash}, {"environment", Json::object()},
      {"failure", failure},      {"first_attempt", first}, {"warms_up", warms_up},   {"attempts", Json::array()},
      {"options", Json::array()}};
  for (const auto &[name, value] : environment) json["environment"][name] = value;
  for (const Attempt &a : attempts) {
    Json norms = Json::array();
    for (const double norm : a.norms) norms.push_back(exact(norm));
    json["attempts"].push_back({{"dt_s", exact(a.dt)}, {"outcome", a.outcome}, {"residual_norms", norms}});
  }
  for (const GivenOption &o : options)
    json["options"].push_back({{"name", o.name}, {"value", o.value}, {"source", o.source}});
  return json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

std::string ReplayFile::read(const std::string &given, std::string &found)
{
  const std::string named = "-replay " + given, damaged = " is damaged; run the scene again";
  std::error_code error;
  std::string content;

  found.clear();
  for (const fs::path &path : {fs::path(given), fs::path(given) / folder})
    if (found.empty() && fs::is_regular_file(path / file, error)) found = fs::absolute(path, error).string();
  if (found.empty())
    return named + ": no " + file +
           " is there; give the directory of a run that failed in a step, which has a folder '" + folder + "'";
  if (!fs::is_regular_file(fs::path(found) / state, error))
    return named + ": " + found + " is incomplete: " + state + " is missing; run the scene again";
  const std::string path = (fs::path(found) / file).string();
  if (!read_text(path, largest_file, content)) return named + ": " + path + " cannot be read; check its permissions";
  try {
    const auto json = nlohmann::json::parse(content);
    const int there = json.at("format");
    if (there != format)
      return named + ": the folder has format " + std::to_string(there) + ", this pulmo reads format " +
             std::to_string(format) + "; replay it with the pulmo that wrote it";
    json.at("version").get_to(version);
    json.at("petsc").get_to(petsc);
    json.at("ranks").get_to(ranks);
    json.at("directory").get_to(directory);
    json.at("mesh").get_to(mesh);
    json.at("mesh_hash").get_to(mesh_hash);
    json.at("failure").get_to(failure);
    json.at("first_attempt").get_to(first);
    json.at("warms_up").get_to(warms_up);
    environment.clear();
    for (const auto &[name, value] : json.at("environment").items()) environment.emplace_back(name, value);
    attempts.clear();
    for (const auto &a : json.at("attempts")) {
      Attempt attempt;
      attempt.dt = std::strtod(a.at("dt_s").get<std::string>().c_str(), nullptr);
      a.at("outcome").get_to(attempt.outcome);
      for (const std::string norm : a.at("residual_norms")) attempt.norms.push_back(std::strtod(norm.c_str(), nullptr));
      attempts.push_back(attempt);
    }
    options.clear();
    for (const auto &o : json.at("options")) options.push_back({o.at("name"), o.at("value"), o.at("source")});
  } catch (const nlohmann::json::exception &) {
    return named + ": " + path + damaged;
  }
  const auto no_option = [](const GivenOption &o) {
    return o.name.size() < 2 || o.name[0] != '-' || std::isalpha(static_cast<unsigned char>(o.name[1])) == 0;
  };
  const bool good = ranks > 0 && !mesh.empty() && first < attempts.size() && !options.empty() &&
                    std::none_of(options.begin(), options.end(), no_option);
  return good ? "" : named + ": " + path + damaged;
}

} // namespace pulmo
