// Lets Klipper's step compressor, built from its sources, time the steps of one move. `virtual-bench/src/peers/klipper.rs`
// compiles this beside them, writes the number of ticks per second, the largest error in ticks and then one instant in
// seconds per line to its input, and reads one line per queued command from its output: tick of the first step,
// interval, steps, and what is added to the interval after each step.
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include "list.h"
#include "stepcompress.h"

#define MOST_COMMANDS (1 << 20)

static int failed(const char *what)
{
    fprintf(stderr, "%s\n", what);
    return EXIT_FAILURE;
}

int main(void)
{
    double ticks_per_s, instant_s;
    uint32_t max_error;
    if (scanf("%lf %" SCNu32, &ticks_per_s, &max_error) != 2)
        return failed("no rate and error");
    struct list_head messages;
    list_init(&messages);
    struct stepcompress *compressor = stepcompress_alloc(&messages);
    stepcompress_fill(compressor, 0, max_error, 0, 0);
    stepcompress_set_time(compressor, 0., ticks_per_s);
    while (scanf("%lf", &instant_s) == 1)
        if (stepcompress_append(compressor, 1, 0., instant_s))
            return failed("a step was refused");
    if (stepcompress_flush(compressor, UINT64_MAX))
        return failed("the steps cannot be compressed");

    struct pull_history_steps *commands = malloc(MOST_COMMANDS * sizeof(*commands));
    if (!commands)
        return failed("no memory");
    int count = stepcompress_extract_old(compressor, commands, MOST_COMMANDS, 0, UINT64_MAX);
    // The newest comes first.
    while (count--)
        printf("%" PRIu64 " %d %d %d\n", commands[count].first_clock, commands[count].interval,
               abs(commands[count].step_count), commands[count].add);
    return EXIT_SUCCESS;
}
