/* From reset to main on a bare Cortex-M4: memory, floating-point unit, output through the debugger (semihosting). */
#include <stdint.h>
#include <stdlib.h>

extern uint32_t data_start, data_end, data_source, bss_start, bss_end, stack_top;
extern void initialise_monitor_handles(void);
extern int main(void);

void reset(void) {
    uint32_t *from = &data_source;
    for (uint32_t *to = &data_start; to < &data_end;) *to++ = *from++;
    for (uint32_t *to = &bss_start; to < &bss_end;) *to++ = 0;
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* CPACR: the coprocessors of the FPU */
    initialise_monitor_handles();
    exit(main());
}

__attribute__((section(".vectors"), used)) void *const vectors[] = {&stack_top, (void *)reset};

/* What newlib asks of an operating system and semihosting does not need. */
void _init(void) {}
void _fini(void) {}
