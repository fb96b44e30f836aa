/* A plugin of QEMU that counts the instructions a program executes, and prints the sum so far at
   each of its writes to standard output. See other_machine.py. What it uses of QEMU's interface,
   version 1, is declared here: headers do not come with the emulator. */
#include <inttypes.h>
#include <stdio.h>

struct qemu_plugin_tb;
typedef uint64_t Id;
size_t qemu_plugin_tb_n_insns(const struct qemu_plugin_tb *block);
void qemu_plugin_register_vcpu_tb_trans_cb(Id id, void (*translated)(Id, struct qemu_plugin_tb *));
void qemu_plugin_register_vcpu_tb_exec_inline(struct qemu_plugin_tb *block, int operation,
                                              void *sum, uint64_t addend);
void qemu_plugin_register_vcpu_syscall_cb(Id id,
                                          void (*called)(Id, unsigned, int64_t, uint64_t, uint64_t,
                                                         uint64_t, uint64_t, uint64_t, uint64_t,
                                                         uint64_t, uint64_t));

__attribute__((visibility("default"))) int qemu_plugin_version = 1;

static uint64_t executed;

static void translated(Id id, struct qemu_plugin_tb *block) {
  enum { kAdd };
  (void)id;
  qemu_plugin_register_vcpu_tb_exec_inline(block, kAdd, &executed, qemu_plugin_tb_n_insns(block));
}

static void called(Id id, unsigned core, int64_t number, uint64_t file, uint64_t a, uint64_t b,
                   uint64_t c, uint64_t d, uint64_t e, uint64_t f, uint64_t g) {
  const int64_t write_x86 = 1, write_arm = 64;
  (void)id, (void)core, (void)a, (void)b, (void)c, (void)d, (void)e, (void)f, (void)g;
  if ((number == write_x86 || number == write_arm) && file == 1)
    fprintf(stderr, "%" PRIu64 "\n", executed);
}

__attribute__((visibility("default"))) int qemu_plugin_install(Id id, const void *info, int count,
                                                               char **arguments) {
  (void)info, (void)count, (void)arguments;
  qemu_plugin_register_vcpu_tb_trans_cb(id, translated);
  qemu_plugin_register_vcpu_syscall_cb(id, called);
  return 0;
}
