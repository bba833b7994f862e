/* Preloaded into linux.uml by with_vcan.sh on processors with AMX.
 *
 * User-mode Linux before 6.13 keeps 2696 bytes of extended registers (x87 to AVX-512 and PKRU), but the kernel of a host
 * with AMX takes nothing shorter than its full 11 kB in PTRACE_SETREGSET, so the guest's first process dies with SIGSEGV.
 * Here every short write is filled up with the host's own length. AMX itself stays off in the guest: nobody asks for it.
 */
#include <errno.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { XSTATE = 0x202, XSTATE_BV = 512, AMX_BITS = 3 << 17 };

static char full[65536] __attribute__((aligned(64))); /* static: the kernel stacks of the guest are small */

static long set_xstate(long pid, const struct iovec *short_state)
{
    struct iovec whole = {full, sizeof full};
    if (syscall(SYS_ptrace, PTRACE_GETREGSET, pid, XSTATE, &whole) < 0)
        return -1;
    if (short_state->iov_len >= whole.iov_len) {
        whole = *short_state;
    } else {
        memset(full + short_state->iov_len, 0, whole.iov_len - short_state->iov_len);
        memcpy(full, short_state->iov_base, short_state->iov_len);
        *(unsigned long *)(full + XSTATE_BV) &= ~(unsigned long)AMX_BITS;
    }
    return syscall(SYS_ptrace, PTRACE_SETREGSET, pid, XSTATE, &whole);
}

long ptrace(enum __ptrace_request request, ...)
{
    va_list rest;
    va_start(rest, request);
    long pid = va_arg(rest, pid_t);
    void *address = va_arg(rest, void *), *data = va_arg(rest, void *);
    va_end(rest);

    if (request == PTRACE_SETREGSET && (long)address == XSTATE)
        return set_xstate(pid, data);
    if (request < PTRACE_PEEKTEXT || request > PTRACE_PEEKUSER)
        return syscall(SYS_ptrace, request, pid, address, data);
    long word, result = syscall(SYS_ptrace, request, pid, address, &word); /* PEEK: the C library returns the word itself */
    if (result < 0)
        return result;
    errno = 0;
    return word;
}
