/// @file
/// Text as people save it: with a byte order mark, with line ends of any system.
#pragma once

#include <string>
#include <utility>
#include <vector>

namespace pulmo {

/// Drops the byte order mark of UTF-8 and makes every line end (LF, CR LF, a lone CR) a newline. What is wrong with
/// the text otherwise (UTF-16, bytes that are no text), to follow the name of its file; empty if nothing is.
std::string clean_text(std::string &text);

/// The lines of a clean text.
std::vector<std::string> lines_of(const std::string &text);

/// Names and values as text, a line "name value" for each, and back. A name has no blanks.
using NamedValues = std::vector<std::pair<std::string, std::string>>;
std::string text_of(const NamedValues &list);
NamedValues named_values(const std::string &text);

/// The first bytes of @p file, @p most at most; false if it cannot be read.
bool read_text(const std::string &file, std::size_t most, std::string &text);

/// A character in @p word that looks like a blank or a dash and is another, by its name in Unicode; empty without one.
std::string look_alike(const std::string &word);

} // namespace pulmo
