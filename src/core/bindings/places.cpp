#include "kernels/postings.hpp"
#include "kernels/word_tree.hpp"

#include "bindings/arrays.hpp"

#include <algorithm>
#include <stdexcept>
#include <string>

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using engram::Input;
using engram::PlaceIndex;
using engram::SealedBlock;
using engram::WordTree;

using Sums = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// Trees come from files: whatever a file says, no search leaves the arrays or runs for ever.
void check_bounds(const Input<int32_t, 1> &bounds, int64_t nodes) {
  if (nodes < 2 || static_cast<int64_t>(bounds.shape(0)) != nodes + 1)
    throw std::invalid_argument("word tree: needs a root with children and one bound per node, "
                                "one more at the end");
  const int32_t *at = bounds.data();
  bool good = at[0] == 1 && at[nodes] == nodes;
  for (int64_t n = 0; good && n < nodes; ++n)
    good = at[n] > n && at[n] <= at[n + 1];
  if (!good)
    throw std::invalid_argument("word tree: its nodes are not in breadth-first order");
}

void make_tree(WordTree *place, const engram::Descriptors &centres,
               const Input<int32_t, 1> &bounds) {
  const auto nodes = static_cast<int64_t>(centres.shape(0));
  check_bounds(bounds, nodes);
  auto *tree = new (place) WordTree{{engram::width_of(centres), nodes}, {}, {}};
  tree->bounds.assign(bounds.data(), bounds.data() + nodes + 1);
  tree->centres.assign(engram::words(centres), nodes);
  int32_t leaves = 0;
  for (size_t n = 0; n < static_cast<size_t>(nodes); ++n)
    tree->words.push_back(tree->bounds[n] == tree->bounds[n + 1] ? leaves++ : -1);
}

auto quantise(const WordTree &tree, const engram::Descriptors &descriptors, int beam) {
  if (beam < 1 || beam > engram::kMaxBeam)
    throw std::invalid_argument("beam is " + std::to_string(beam) + ", must be 1 to " +
                                std::to_string(engram::kMaxBeam));
  if (engram::width_of(descriptors) != tree.centres.width)
    throw std::invalid_argument("word tree: its words and these descriptors differ in width");
  const size_t count = descriptors.shape(0);
  std::vector<int32_t> words(count);
  {
    nb::gil_scoped_release unlocked;
    ENGRAM_CALL(quantise, tree, engram::words(descriptors), static_cast<int64_t>(count), beam,
                words.data());
  }
  return engram::to_numpy(std::move(words), {count});
}

auto k_majority(const engram::Descriptors &descriptors, int64_t k, int iterations, uint64_t seed) {
  const size_t count = descriptors.shape(0);
  if (count == 0 || k < 1 || iterations < 0)
    throw std::invalid_argument("k_majority: needs descriptors, k >= 1 and iterations >= 0");
  const size_t most = std::min(count, static_cast<size_t>(k));
  const int width = engram::width_of(descriptors);
  const auto columns = static_cast<size_t>(width);
  std::vector<uint64_t> centres(columns * most);
  std::vector<int32_t> assignment(count);
  int64_t found = 0;
  {
    nb::gil_scoped_release unlocked;
    found = ENGRAM_CALL(k_majority, engram::words(descriptors), static_cast<int64_t>(count),
                        width, static_cast<int64_t>(most), iterations, seed, centres.data(),
                        assignment.data());
  }
  centres.resize(columns * static_cast<size_t>(found));
  return nb::make_tuple(engram::to_numpy(std::move(centres), {static_cast<size_t>(found), columns}),
                        engram::to_numpy(std::move(assignment), {count}));
}

void check_words(int64_t most, const Input<int32_t, 1> &words, bool rising) {
  for (size_t i = 0; i < words.shape(0); ++i) {
    const int32_t word = words.data()[i];
    if (word < 0 || word >= most)
      throw std::invalid_argument("word " + std::to_string(word) + ": the index has words 0 to " +
                                  std::to_string(most - 1));
    if (rising && i > 0 && word <= words.data()[i - 1])
      throw std::invalid_argument("the words of a place must rise strictly");
  }
}

int64_t add_place(PlaceIndex &index, const Input<int32_t, 1> &words) {
  check_words(index.words(), words, true);
  return index.add(words.data(), static_cast<int64_t>(words.shape(0)));
}

void add_weights(const PlaceIndex &index, const Input<int32_t, 1> &words,
                 const Input<double, 1> &weights, Sums sums) {
  check_words(index.words(), words, false);
  if (words.shape(0) != weights.shape(0))
    throw std::invalid_argument("add_weights: one weight per word");
  if (static_cast<int64_t>(sums.shape(0)) != index.places())
    throw std::invalid_argument("add_weights: one sum per place");
  nb::gil_scoped_release unlocked;
  ENGRAM_CALL(add_weights, index, words.data(), weights.data(),
              static_cast<int64_t>(words.shape(0)), sums.data());
}

nb::bytes block_body(const PlaceIndex &index, int64_t number) {
  if (number < 0 || number >= index.sealed())
    throw std::invalid_argument("block " + std::to_string(number) + ": " +
                                std::to_string(index.sealed()) + " blocks are full");
  const std::vector<uint8_t> &body = index.body(number);
  return nb::bytes(body.data(), body.size());
}

void add_block_weights(nb::bytes body, int64_t words_in_all, const Input<int32_t, 1> &words,
                       const Input<double, 1> &weights, Sums sums) {
  check_words(words_in_all, words, false);
  if (words.shape(0) != weights.shape(0))
    throw std::invalid_argument("add_block_weights: one weight per word");
  if (static_cast<int64_t>(sums.shape(0)) != PlaceIndex::block_size)
    throw std::invalid_argument("add_block_weights: one sum per place of the block");
  if (!SealedBlock::holds(body.size(), words_in_all))
    throw std::invalid_argument("a block of places is too short for its words");
  const SealedBlock block(static_cast<const uint8_t *>(body.data()), body.size(), words_in_all);
  bool within = false;
  {
    nb::gil_scoped_release unlocked;
    within = ENGRAM_CALL(add_weights, block, words.data(), weights.data(),
                         static_cast<int64_t>(words.shape(0)), sums.data(),
                         PlaceIndex::block_size);
  }
  if (!within)
    throw std::invalid_argument("a block of places names places beyond its end");
}

auto best_scores(const Input<double, 1> &scores, int64_t most) {
  std::vector<int64_t> best;
  {
    nb::gil_scoped_release unlocked;
    best = engram::best_scores(scores.data(), static_cast<int64_t>(scores.shape(0)), most);
  }
  const size_t count = best.size();
  return engram::to_numpy(std::move(best), {count});
}

} // namespace

void bind_places(nb::module_ &module) {
  nb::class_<WordTree>(module, "WordTree", "A tree of binary words, ready to be searched.")
      .def("__init__", &make_tree, "centres"_a, "bounds"_a)
      .def("quantise", &quantise, "descriptors"_a, "beam"_a,
           "Word (N,) int32 of each descriptor (N, B) uint8.");
  module.def("k_majority", &k_majority, "descriptors"_a, "k"_a, "iterations"_a, "seed"_a,
             "Centres (K, B / 8) uint64, K <= k, and the cluster (N,) int32 of each descriptor.");
  module.def("best_scores", &best_scores, "scores"_a, "most"_a,
             "Numbers (K,) int64 of the greatest scores, greatest first, ties by number.");
  nb::class_<PlaceIndex>(module, "PlaceIndex", "For each word the places that show it.")
      .def("__init__",
           [](PlaceIndex *place, int64_t words) {
             if (words < 1)
               throw std::invalid_argument("PlaceIndex: needs at least one word");
             new (place) PlaceIndex(words);
           },
           "words"_a)
      .def("__len__", &PlaceIndex::places)
      .def_prop_ro("bytes", &PlaceIndex::bytes)
      .def("add", &add_place, "words"_a, "Adds a place with rising words; returns its number.")
      .def("add_weights", &add_weights, "words"_a, "weights"_a, "sums"_a,
           "sums (P,) += the weights (W,) of those words (W,) that each place shows.")
      .def_prop_ro("sealed", &PlaceIndex::sealed, "Number of full blocks.")
      .def("block", &block_body, "number"_a, "A full block, in the bytes that maps store.");
  module.attr("PLACES_PER_BLOCK") = PlaceIndex::block_size;
  module.def("add_block_weights", &add_block_weights, "body"_a, "words_in_all"_a, "words"_a,
             "weights"_a, "sums"_a, "As `PlaceIndex.add_weights`, of one full block.");
}
