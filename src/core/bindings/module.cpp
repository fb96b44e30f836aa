// engram._core: arrays in, arrays out. Each subject binds its own kernels in a file of its own:
// declare its bind_… function here and call it below.
#include <nanobind/nanobind.h>

#include "dispatch.hpp"

namespace nb = nanobind;

void bind_extraction(nb::module_ &module);
void bind_graph_search(nb::module_ &module);
void bind_hamming(nb::module_ &module);
void bind_kept(nb::module_ &module);
void bind_matching(nb::module_ &module);
void bind_odometry(nb::module_ &module);
void bind_ordering(nb::module_ &module);
void bind_patch_network(nb::module_ &module);
void bind_path_scores(nb::module_ &module);
void bind_places(nb::module_ &module);
void bind_recall(nb::module_ &module);
void bind_rows(nb::module_ &module);
void bind_transforms(nb::module_ &module);
void bind_window_ba(nb::module_ &module);

NB_MODULE(_core, module) {
  // An error's traceback may keep arrays alive until the interpreter is gone; that is no leak.
  nb::set_leak_warnings(false);
  module.doc() = "The measured hot kernels of Engram. See _core.pyi for which release the GIL.";
  module.attr("isa") = engram::name_of(engram::active_isa());
  bind_extraction(module);
  bind_graph_search(module);
  bind_hamming(module);
  bind_kept(module);
  bind_matching(module);
  bind_odometry(module);
  bind_ordering(module);
  bind_patch_network(module);
  bind_path_scores(module);
  bind_places(module);
  bind_recall(module);
  bind_rows(module);
  bind_transforms(module);
  bind_window_ba(module);
}
