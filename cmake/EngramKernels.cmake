# What both extension modules share: how a kernel file is compiled once per instruction set.

# No contraction to FMA and no reassociation: every instruction set computes the same bits.
set(kernel_flags -Wall -Wextra -Wno-psabi -ffp-contract=off -fno-math-errno -fno-trapping-math)

# Compiles the kernels for one instruction set, in a namespace of its name, into the module.
function(add_kernels module isa sources)
  set(objects ${module}_${isa})
  add_library(${objects} OBJECT ${sources})
  get_target_property(includes ${module} INCLUDE_DIRECTORIES)
  target_include_directories(${objects} PRIVATE ${includes})
  target_compile_definitions(${objects} PRIVATE ENGRAM_ISA=${isa})
  target_compile_options(${objects} PRIVATE ${kernel_flags} -fvisibility=hidden ${ARGN})
  set_target_properties(${objects} PROPERTIES POSITION_INDEPENDENT_CODE ON)
  target_link_libraries(${module} PRIVATE ${objects})
endfunction()

# The plainest comes first: of an inline function that several of them leave out of line the linker
# keeps the first copy, and that one must run everywhere.
function(add_all_kernels module sources)
  target_compile_options(${module} PRIVATE ${kernel_flags})
  add_kernels(${module} generic "${sources}")
  if(CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64|amd64")
    target_compile_definitions(${module} PRIVATE ENGRAM_X86)
    add_kernels(${module} v3 "${sources}" -march=x86-64-v3)
    add_kernels(${module} v4 "${sources}" -march=x86-64-v4 -mavx512vpopcntdq -mavx512vnni
                -mprefer-vector-width=512)
  endif()
endfunction()
