/* A loop over the steps of an exported model, and clocks, for experiments/export.

   Compiled with -DMODEL=name and -DSOURCE="name.c", which is included, so that the compiler takes both as a whole:
   a library with `export_run`, and a program that keeps deadlines.

   program paced PERIOD COUNT WORK    at each PERIOD (ns), COUNT times, does a step, where WORK is "step", or waits for so
                                      many ns, busily; prints for each how late it woke, how late it ended, and how long
                                      it ran itself in between, by the kernel's account, in ns
   program turns COUNT STEPS          COUNT times back to back STEPS steps, 1 or 0: the number of times for each length
                                      in ns, and the worst

   The first line tells whether there is real-time scheduling: paced loops ask for it, and for locked memory. Steps back
   to back do not, because the kernel stops for 50 ms whoever has it and never sleeps. */

#define _POSIX_C_SOURCE 200112L
#define JOIN_(a, b) a##_##b
#define JOIN(a, b) JOIN_(a, b)
#define OF(name) JOIN(MODEL, name)
#include SOURCE

#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>

#define LONGEST 200000 /* ns, of the lengths that are counted one by one */

int export_run(OF(state) *, const OF(params) *, long, double, double *);
unsigned long export_sizes(void);

static long long by(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return 1000000000LL * t.tv_sec + t.tv_nsec;
}

static long long now(void) { return by(CLOCK_MONOTONIC); }

unsigned long export_sizes(void) { return sizeof(OF(state)); }

/* path: the first number of the state after t, after every step, or null */
int export_run(OF(state) *s, const OF(params) *p, long steps, double dt, double *path)
{
    OF(state) y = *s;
    const OF(params) own = *p; /* which a path cannot overlap */
    long i;
    for (i = 0; i < steps; i++) {
        (void)OF(step)(&y, &own, NULL, dt);
        if (path != NULL) {
            path[i] = ((const double *)&y)[1];
        }
    }
    *s = y;
    return y.flags;
}

#ifdef STARTS
static int begin(OF(state) *s, double dt)
{
    static const double q0[] = {STARTS}, v0[] = {SPEEDS};
    return OF(init)(s, &OF(defaults), q0, v0, 0, dt);
}

static void ask_for_real_time(void)
{
    struct sched_param priority;
    priority.sched_priority = 50;
    printf("%d 0 0\n", sched_setscheduler(0, SCHED_FIFO, &priority) == 0);
    (void)mlockall(MCL_CURRENT | MCL_FUTURE);
}

static int paced(long period, long count, const char *work)
{
    static OF(state) s;
    const int steps = strcmp(work, "step") == 0;
    const long wait = steps ? 0 : atol(work);
    long long(*const found)[3] = calloc((size_t)count, sizeof *found);
    long long due = now() + 10000000;
    long i;
    if (found == NULL) {
        return 1;
    }
    (void)begin(&s, 1e-9 * (double)period);
    for (i = 0; i < count; i++, due += period) {
        struct timespec t;
        long long woken, own;
        t.tv_sec = due / 1000000000LL, t.tv_nsec = due % 1000000000LL;
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) != 0) {
        }
        woken = now();
        own = by(CLOCK_THREAD_CPUTIME_ID);
        if (steps) {
            (void)OF(step)(&s, &OF(defaults), NULL, 1e-9 * (double)period);
        } else if (wait > 0) {
            const long long until = now() + wait;
            while (now() < until) {
            }
        }
        found[i][2] = by(CLOCK_THREAD_CPUTIME_ID) - own;
        found[i][1] = now() - due, found[i][0] = woken - due;
    }
    for (i = 0; i < count; i++) {
        printf("%lld %lld %lld\n", found[i][0], found[i][1], found[i][2]);
    }
    free(found);
    return s.flags;
}

static int turns(long count, int steps)
{
    static OF(state) s;
    static long lengths[LONGEST + 1];
    long long worst = 0, before = now();
    long i;
    (void)begin(&s, 1e-3);
    for (i = 0; i < count; i++) {
        long long after;
        if (steps) {
            (void)OF(step)(&s, &OF(defaults), NULL, 1e-3);
        }
        after = now();
        lengths[after - before < LONGEST ? after - before : LONGEST]++;
        worst = after - before > worst ? after - before : worst;
        before = after;
    }
    printf("%lld 0\n", worst);
    for (i = 0; i <= LONGEST; i++) {
        if (lengths[i] > 0) {
            printf("%ld %ld\n", i, lengths[i]);
        }
    }
    return s.flags;
}

int main(int argc, char **argv)
{
    if (argc == 5) {
        ask_for_real_time();
        return paced(atol(argv[2]), atol(argv[3]), argv[4]);
    }
    puts("0 0");
    return argc == 4 ? turns(atol(argv[2]), atoi(argv[3])) : 1;
}
#endif
