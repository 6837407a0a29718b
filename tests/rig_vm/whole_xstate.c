/* Preloaded into User-mode Linux, whose kernel 6.1 keeps 2696 bytes of a process's extended processor state: enough for
 * AVX-512, while a processor with AMX has 11008, and its kernel refuses to set a part of them (EFAULT; the guest then
 * panics in put_fp_registers before its init runs). What the guest did not keep is set to zero: tiles, which no program
 * has that has not asked for them, and which the state's header, among what is kept, says are in their initial state. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

static long (*host_ptrace)(int, int, void *, void *);

long ptrace(enum __ptrace_request request, ...) {
  static char whole[1 << 16]; /* the guest has one processor, whose kernel is one thread */
  static size_t size;
  va_list rest;
  va_start(rest, request);
  int pid = va_arg(rest, int);
  void *address = va_arg(rest, void *);
  void *data = va_arg(rest, void *);
  va_end(rest);
  if (!host_ptrace) host_ptrace = (long (*)(int, int, void *, void *))dlsym(RTLD_NEXT, "ptrace");
  if (request == PTRACE_SETREGSET && address == (void *)NT_X86_XSTATE) {
    struct iovec kept = *(struct iovec *)data, all = {whole, sizeof whole};
    if (!size) { /* it is the same for all processes; asked once, for this call is made at every switch */
      size = host_ptrace(PTRACE_GETREGSET, pid, address, &all) == 0 ? all.iov_len : kept.iov_len;
      memset(whole, 0, sizeof whole);
    }
    if (size > kept.iov_len) {
      memcpy(whole, kept.iov_base, kept.iov_len);
      all.iov_len = size;
      return host_ptrace(PTRACE_SETREGSET, pid, address, &all);
    }
  }
  return host_ptrace(request, pid, address, data);
}
