"""Small native programs for the injector, compiled once a session."""

import shutil
import subprocess

import pytest

SOURCES = {
    # Writes what it reads from standard input, and its double; prints a time. args: the files, also
    # as NAME=FILE.
    "writing": """
#include <stdio.h>
#include <string.h>
#include <time.h>
int main(int c, char **v) {
    double x = 7; struct timespec now; clock_gettime(CLOCK_REALTIME, &now);
    if (scanf("%lf", &x) < 0) x = 7;
    for (int i = 1; i < c; i++) {
        char *at = strchr(v[i], '='); FILE *f = fopen(at ? at + 1 : v[i], "w");
        if (!f) { puts("no such file"); return 3; }
        fprintf(f, "%g %g\\n", x, 2 * x); fclose(f);
    }
    printf("Time = %ld.%09ld\\nx = %g\\n", (long) now.tv_sec, now.tv_nsec, x);
    return 0;
}""",
    # A loop whose counter is an argument of the called function; arg: iterations.
    "counting": """
#include <stdio.h>
#include <stdlib.h>
volatile long sink; double sum;
__attribute__((noinline)) void body(long i) { sink = i; sum += 1.0 / (i + 1); }
int main(int c, char **v) {
    long n = c > 1 ? atol(v[1]) : 100;
    for (long i = 0; i < n; i++) body(i);
    printf("%ld %.17g\\n", sink, sum);
    return 0;
}""",
    # Three threads call `work` for ever. It prints the number of calls for each character it reads.
    "workers": """
#include <pthread.h>
#include <stdio.h>
static volatile long calls[3]; static volatile double sum;
void never(void) { puts("never"); }
__attribute__((noinline)) double work(long n) {
    double x = 1; for (long i = 1; i < 200; i++) x += (double) n / i; return x;
}
static void *run(void *at) { for (;;) { sum = work(++*(volatile long *) at); } return 0; }
int main(void) {
    pthread_t t; for (int i = 0; i < 3; i++) pthread_create(&t, 0, run, (void *) &calls[i]);
    puts("ready"); fflush(stdout);
    for (int c; (c = getchar()) != EOF;) {
        if (c == '!') run((void *) &calls[0]);
        if (getchar() == EOF) break;
        printf("%ld\\n", calls[0] + calls[1] + calls[2]); fflush(stdout);
    }
    return 0;
}""",
    # For -nostdlib -static: no object of it has writable data.
    "bare": """
static void call(long number, long a, long b, long c) {
    __asm__ volatile("syscall" : "+a"(number) : "D"(a), "S"(b), "d"(c) : "rcx", "r11", "memory");
}
void _start(void) {
    unsigned long x = 88172645463325252UL;
    for (int i = 0; i < 3000; i++) { x ^= x << 13; x ^= x >> 7; x ^= x << 17; }
    call(1, 1, (long) &x, 8);
    call(60, 0, 0, 0);
}""",
    # Each way in which a detour moves an instruction: relative to rip, jumps, calls, repeated ones,
    # and blocks that are too short for a long jump.
    "flows": r"""
#include <stdio.h>
long cell = 3; char from[64] = "0123456789", into[64];
__attribute__((naked, noinline)) long flows(void) {
    __asm__ volatile(
        "mov $400, %r8d\nxor %eax, %eax\njmp 4f\n"
        "1: dec %r8d\njz 3f\n"
        "4: add cell(%rip), %rax\ntest $1, %al\njne 1b\n"
        "nop\ncall 5f\nmov $8, %ecx\nlea from(%rip), %rsi\nlea into(%rip), %rdi\n"
        "rep movsb\njmp 1b\n"
        "3: ret\n"
        "ud2\n.nops 16\n"
        "5: imul $5, %rax, %rax\npushq %rax\nadd $8, %rsp\nret\n");
}
int main(void) { printf("%ld %s\n", flows(), into); return 0; }""",
    # A hot loop that reads a constant beside it; nothing else unused is near. arg: iterations.
    "beside": r"""
#include <stdio.h>
#include <stdlib.h>
__attribute__((naked, noinline)) long hot(long n) {
    __asm__ volatile(
        ".rept 140\nnop\n.endr\nlea 9f(%rip), %rsi\nxor %eax, %eax\n"
        "1: add (%rsi), %eax\njmp 2f\n"
        "9: .quad 0x123456789\n"
        "2: dec %edi\njnz 1b\nret\n");
}
int main(int c, char **v) { printf("%ld\n", hot(atol(v[1]))); return 0; }""",
    # A loop that reads its own code. arg: iterations.
    "introspective": """
#include <stdio.h>
#include <stdlib.h>
__attribute__((noinline)) unsigned long walk(long n) {
    unsigned long sum = 0;
    for (long i = 0; i < n; i++) sum = sum * 31 + ((unsigned char *) walk)[i % 64];
    return sum;
}
int main(int c, char **v) { printf("%lu\\n", walk(atol(v[1]))); return 0; }""",
    # Prints the beginning of a file. arg: its path.
    "seconds": r"""  // prints the time in seconds
        #include <stdio.h>
        #include <time.h>
        int main(void) {
            volatile long sum = 0;
            for (int i = 0; i < 1000; ++i) sum += i;
            printf("%ld %ld\n", sum, (long)time(NULL));
            return 0;
        }
    """,
    "echoing": """
#include <stdio.h>
int main(int c, char **v) {
    char text[9] = ""; FILE *f = fopen(v[1], "r"); fread(text, 1, 8, f); fclose(f);
    for (int i = 0; i < 300; i++) text[8] ^= i;
    puts(text);
    return 0;
}""",
    # Callbacks from libc into the program; every comparison is in scope.
    "sorting": """
#include <stdio.h>
#include <stdlib.h>
volatile long calls;
static int compare(const void *a, const void *b) {
    calls++; return *(const int *)a - *(const int *)b;
}
int main(void) {
    int v[] = {9, 3, 7, 1, 8, 2};
    qsort(v, 6, sizeof *v, compare);
    for (int i = 0; i < 6; i++) printf("%d ", v[i]);
    printf("%ld\\n", calls);
    return 0;
}""",
    # Stops at `here` with everything under our control; the tests write what they need.
    "sleeper": """
#include <stdio.h>
#include <time.h>
int main(void) {
    struct timespec t = {0, 150000000};
    printf("%d\\n", nanosleep(&t, 0));
    return 0;
}""",
    "threads": """
#include <pthread.h>
#include <stdio.h>
volatile long sink; static long total[3];
static void *work(void *p) { for (int i = 0; i < 1000; i++) ++*(long *)p; return 0; }
__attribute__((noinline)) void body(long i) { sink = i; }
int main(void) {
    pthread_t t[3];
    for (int i = 0; i < 3; i++) pthread_create(&t[i], 0, work, &total[i]);
    for (long i = 0; i < 20; i++) body(i);
    for (int i = 0; i < 3; i++) pthread_join(t[i], 0);
    printf("%ld\\n", total[0] + total[1] + total[2] + sink);
    return 0;
}""",
    # Handles its own signals, the tracer's favourite one included.
    "signals": """
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
static volatile sig_atomic_t seen;
static void handle(int number) {
    seen += number;
    if (number == SIGSEGV) { puts("caught"); exit(0); }
}
__attribute__((noinline)) void body(long i) { raise(i % 2 ? SIGUSR1 : SIGTRAP); }
int main(void) {
    signal(SIGUSR1, handle); signal(SIGTRAP, handle); signal(SIGSEGV, handle);
    for (long i = 0; i < 6; i++) body(i);
    printf("%d\\n", (int)seen);
    *(volatile int *)0 = 1;
    return 1;
}""",
    # Starts a child that outlives it.
    "parent": """
#include <stdio.h>
#include <unistd.h>
#include <sys/wait.h>
int main(void) {
    if (fork() == 0) return 3;
    int status; wait(&status);
    pid_t left = fork();
    if (left == 0) { pause(); return 0; }
    printf("%d %d\\n", WEXITSTATUS(status), left);
    return 0;
}""",
    # Bad guests: what the first argument names.
    "guest": """
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
int main(int c, char **v) {
    if (!strcmp(v[1], "prints")) for (int i = 0; i < 10000000; i++) puts("0123456789");
    if (!strcmp(v[1], "eats")) {
        for (long i = 0; i < 3000; i++) {
            char *p = malloc(1 << 20); if (!p) return 9;
            p[0] = 1;
        }
    }
    if (!strcmp(v[1], "writes")) { int f = open(v[2], O_WRONLY | O_CREAT, 0644); write(f, "x", 1); }
    if (!strcmp(v[1], "asks") && open("/dev/tty", O_RDWR) < 0) {
        fputs("no terminal here\\n", stderr); return 1;
    }
    if (!strcmp(v[1], "waits")) pause();
    if (!strcmp(v[1], "reads")) { char t[9]; FILE *f = fopen("in", "r"); puts(fgets(t, 9, f)); }
    if (!strcmp(v[1], "pipes")) {
        int p[2]; char t[2]; pipe(p);
        if (fork() == 0) { pause(); return 0; }
        read(p[0], t, 1);
    }
    if (!strcmp(v[1], "execs")) execlp("true", "true", NULL);
    if (!strcmp(v[1], "says")) puts(getenv(v[2]) ? getenv(v[2]) : "nothing");
    puts("done");
    return 0;
}""",
    # A place for one instruction, and memory around its operand.
    "probe": """
char page[1 << 17];
__attribute__((naked, noinline)) void slot(void) { __asm__ volatile(".fill 32, 1, 0x90"); }
int main(void) { slot(); return page[0]; }""",
    # Known outcomes: `victim` is the attacked function.
    "benign": """
#include <stdio.h>
__attribute__((noinline)) void victim(void) { __asm__ volatile("mov $1, %%r10" ::: "r10"); }
int main(void) { victim(); puts("done"); return 0; }""",
    "crash": """
#include <stdio.h>
int value = 1;
__attribute__((noinline)) int victim(void) {
    int r; int *p = &value;
    __asm__ volatile("mov %1, %%r10\\n\\tmov (%%r10), %0" : "=r"(r) : "r"(p) : "r10");
    return r;
}
int main(void) { printf("%d\\n", victim()); return 0; }""",
    "hang": """
#include <stdio.h>
__attribute__((noinline)) void victim(void) {
    __asm__ volatile("mov $0, %%r10\\n1:\\ttest %%r10, %%r10\\n\\tjne 1b" ::: "r10", "cc");
}
int main(void) { victim(); puts("done"); return 0; }""",
    "sdc": """
#include <stdio.h>
__attribute__((noinline)) long victim(void) {
    long r; __asm__ volatile("mov $7, %%r10\\n\\tmov %%r10, %0" : "=r"(r) :: "r10"); return r;
}
int main(void) { printf("%ld\\n", victim()); return 0; }""",
    # Every conditional jump, near and far, with every value of the flags that it depends on.
    "jumps": r"""
#include <stdio.h>
#define JUMP(condition, distance) \
    "push %[flags]\n\tpopfq\n\t" distance " j" condition " 1f\n\tinc %[n]\n" \
    "1:\n\tlea (%[n], %[n], 2), %[n]\n\t"
#define BOTH(condition) JUMP(condition, "%{disp8%}") JUMP(condition, "%{disp32%}")
unsigned long taken(unsigned long flags, unsigned long n) {
    __asm__ volatile("sub $128, %%rsp\n\t"
        BOTH("o") BOTH("no") BOTH("b") BOTH("ae") BOTH("e") BOTH("ne") BOTH("be") BOTH("a")
        BOTH("s") BOTH("ns") BOTH("p") BOTH("np") BOTH("l") BOTH("ge") BOTH("le") BOTH("g")
        "mov $3, %%ecx\n2:\n\tinc %[n]\n\tloop 2b\n\tjrcxz 3f\n\tinc %[n]\n3:\n\t"
        "lea 4f(%%rip), %%rcx\n\tjmp *%%rcx\n4:\n\t%{disp32%} jmp 5f\n5:\n\tsub $-128, %%rsp"
        : [n] "+r"(n) : [flags] "r"(flags | 2) : "rcx", "cc", "memory");
    return n;
}
int main(void) {
    unsigned long n = 1;
    for (int bits = 0; bits < 32; bits++)
        n = taken((bits & 1) | (bits & 2) << 1 | (bits & 4) << 4 | (bits & 8) << 4
                  | (bits & 16) << 7, n);
    printf("%lx\n", n);
    return 0;
}""",
    # One labelled instruction of each kind whose destination must not be lost.
    "destinations": r"""
#include <stdio.h>
char from[64] = "0123456789abcdefghijklmnopqrstuvwxyz", into[64];
long cell = 0x1122;
__attribute__((naked, noinline)) void parade(void) {
    __asm__ volatile(
        ".globl at_mov\nat_mov:  mov $5, %rax\n"
        ".globl at_add\nat_add:  add $3, %rax\n"
        ".globl at_load\nat_load: mov cell(%rip), %rcx\n"
        "push $77\n"
        ".globl at_pop\nat_pop:  pop %rdx\n"
        ".globl at_call\nat_call: call 1f\n1: add $8, %rsp\n"
        "lea from(%rip), %rsi\nlea into(%rip), %rdi\nmov $36, %rcx\n"
        ".globl at_movs\nat_movs: rep movsb\n"
        ".globl at_store\nat_store: movl $9, cell(%rip)\n"
        ".globl at_pushf\nat_pushf: pushfq\n"
        ".globl at_popf\nat_popf: popfq\n"
        "ret\n");
}
int main(void) { parade(); printf("%s %ld\n", into, cell); return 0; }""",
}


@pytest.fixture(scope="session")
def native_program(tmp_path_factory):
    """Function from a program's name to its compiled path."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("gcc is not installed")
    reason = tracing_problem()
    if reason:
        pytest.skip(reason)
    folder = tmp_path_factory.mktemp("native")

    def build(name, *options):
        path = folder / "".join((name, *options))
        if not path.exists():
            source = folder / f"{name}.c"
            source.write_text(SOURCES[name])
            subprocess.run(
                [compiler, "-O1", "-pthread", *options, "-o", str(path), str(source)], check=True
            )
        return path

    return build


def tracing_problem():
    """Why nothing can be traced here, or None."""
    import platform

    if platform.machine() != "x86_64":
        return f"instruction-level injection does not know {platform.machine()}"
    from mavfi_cli.mission.machine import OK, check_tracing

    found = check_tracing()
    return None if found.verdict == OK else found.finding


@pytest.fixture
def start(native_program, tmp_path):
    """Function that starts a program at its entry point; what it leaves behind is killed."""
    from mavfi_cli.fi.tracer.spawn import Program, run_to_entry, spawn

    tracees = []

    def begin(name, *arguments, mechanism=None):
        command = Program.of([str(native_program(name)), *arguments])
        tracee = spawn(
            command, stdout=tmp_path / "stdout", stderr=tmp_path / "stderr", mechanism=mechanism
        )
        tracees.append(tracee)
        assert run_to_entry(tracee)
        return tracee

    yield begin
    for tracee in tracees:
        tracee.kill()


def register_corruption(register, bit, role=None):
    """The corruption of one bit of a general register or the flags."""
    from mavfi_cli.fi.tracer.fault import InstructionCorruption, Role, Site

    return InstructionCorruption(
        site=Site.FLAGS if register == "rflags" else Site.GENERAL, role=role or Role.SOURCE,
        register=register, operand=register, bits=(bit,),
    )  # fmt: skip


def all_registers():
    """Every full register of this processor that can be flipped."""
    from mavfi_cli.fi.tracer.decode import GENERAL
    from mavfi_cli.fi.tracer.registers import widest_vector

    widest = widest_vector()
    names = [*GENERAL, "rflags", "rip", *(f"st{number}" for number in range(8))]
    names += [f"{widest}{number}" for number in range(32 if widest == "zmm" else 16)]
    return (*names, *(f"k{number}" for number in range(8 if widest == "zmm" else 0)))
