//! A DMA stream over a ring in memory, one item per request: the step timer's periods, the captured instants, the
//! received bytes. Unlike the emulator's own streams it can skip many items at once; it moves single items exactly as
//! they do.

use rigless::device::{DeviceContext, Level, RegisterFile, RequestChange};
use rigless::soc::stm32f427::generated::dma2::Register;
use rigless::soc::{Layout, Width};

/// Bits of SxCR, SxNDTR and SxFCR (RM0383 sections 9.5.5 to 9.5.10).
const EN: u64 = 1 << 0;
/// Bits that may be written while the stream is enabled: EN and the interrupt enables.
const OPEN: u64 = 0x1F;
const DMEIE: u64 = 1 << 1;
const HTIE: u64 = 1 << 3;
const TCIE: u64 = 1 << 4;
const CIRC: u64 = 1 << 8;
const MINC: u64 = 1 << 10;
/// Modes that are not supported: peripheral flow control, peripheral increment, double buffer.
const OTHER_MODES: u64 = 1 << 5 | 1 << 9 | 1 << 18;
/// Bits that direct mode clears: PINCOS, PBURST, MBURST.
const NOT_DIRECT: u64 = 1 << 15 | 3 << 21 | 3 << 23;
const NDT: u64 = 0xFFFF;
const DMDIS: u64 = 1 << 2;
const FS: u64 = 7 << 3;
const FS_EMPTY: u64 = 4;
const FEIE: u64 = 1 << 7;
/// Flags of a stream in HISR, before the shift to its position.
const FEIF: u64 = 1 << 0;
const TEIF: u64 = 1 << 3;
const HTIF: u64 = 1 << 4;
const TCIF: u64 = 1 << 5;
const FLAGS: u64 = 0x3D;
/// Bit positions of the flags of streams 4 to 7.
const FLAG_SHIFTS: [u32; 4] = [0, 6, 16, 22];
/// Registers before the first stream's, and registers per stream.
const FIRST: usize = 4;
const ROWS: usize = 6;

/// Registers of a stream, in their order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Row {
    Control,
    Count,
    Peripheral,
    Memory0,
    Memory1,
    Fifo,
}

const ALL: [Row; ROWS] = [
    Row::Control,
    Row::Count,
    Row::Peripheral,
    Row::Memory0,
    Row::Memory1,
    Row::Fifo,
];

/// The stream of a ring, and the request that drives it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct StreamId {
    /// Stream number, 4 to 7.
    pub(super) stream: usize,
    pub(super) channel: u64,
    pub(super) instance: &'static str,
    pub(super) request: usize,
}

/// Behaviour of a stream that the manuals do not define.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Streams {
    /// Switched off and on again, it continues with the remaining number of items, unless NDTR was written in between.
    pub keeps_count: bool,
    /// Switched off and on again, it continues at the next address, unless M0AR was written in between.
    pub keeps_address: bool,
    /// FEIF at each item: in direct mode the FIFO of one item is empty, or full, whenever the bus is not granted.
    pub fifo_errors: bool,
}

/// The stream.
#[derive(Debug)]
pub(super) struct Ring {
    id: StreamId,
    streams: Streams,
    /// Remaining bytes and the next address when it was switched off, until they are written.
    remaining: (Option<u64>, Option<u64>),
    requested: bool,
    /// NDTR as last written: each round restarts from it.
    programmed: u64,
    /// Enabled since the last write to its registers.
    enabled: bool,
    /// Its registers at that time.
    kept: [u64; ROWS],
    running: Option<Running>,
    /// Flags have changed, so the interrupt may have changed too.
    pub(super) flagged: bool,
}

#[derive(Clone, Copy, Debug)]
struct Running {
    from_memory: bool,
    /// Bytes per item.
    bytes: u64,
    total: u64,
    to_load: u64,
    to_store: u64,
    memory_at: u64,
    held: Option<u64>,
    /// A bus access is pending.
    outstanding: bool,
    halved: bool,
}

impl Ring {
    pub(super) fn new(id: StreamId, streams: Streams) -> Self {
        Self {
            id,
            streams,
            remaining: (None, None),
            requested: false,
            programmed: 0,
            enabled: false,
            kept: [0; ROWS],
            running: None,
            flagged: false,
        }
    }

    pub(super) fn is_running(&self) -> bool {
        self.running.is_some()
    }

    /// The present state of the request, for the emulator's stream.
    pub(super) fn request_state(&self) -> RequestChange {
        RequestChange {
            instance: self.id.instance,
            request: self.id.request,
            level: Level::from(self.requested),
        }
    }

    /// Whether this request is for this ring.
    pub(super) fn hears(&self, instance: &str, request: usize) -> bool {
        self.id.instance == instance && self.id.request == request
    }

    /// Whether this answer is for this ring, and if so, whether it answers a store.
    pub(super) fn answers(&self, token: u64) -> Option<bool> {
        let mine = self.running.is_some() && token / 2 == self.id.stream as u64;
        mine.then_some(token % 2 == 1)
    }

    /// The register's position among those of the stream, if it is one of them.
    pub(super) fn row(&self, register: Register) -> Option<Row> {
        let nth = register
            .index()
            .checked_sub(FIRST + self.id.stream * ROWS)?;
        ALL.get(nth).copied()
    }

    fn register(&self, row: Row) -> Register {
        let index = FIRST + self.id.stream * ROWS + row as usize;
        Register::from_index(index).expect("eight streams of six registers")
    }

    fn held(&self, registers: &RegisterFile, row: Row) -> u64 {
        registers.get(self.register(row))
    }

    fn set(&self, registers: &mut RegisterFile, row: Row, mask: u64, value: u64) {
        let before = self.held(registers, row);
        registers.set(self.register(row), before & !mask | value & mask);
    }

    fn flag(&mut self, registers: &mut RegisterFile, flags: u64) {
        let before = registers.get(Register::Hisr);
        registers.set(
            Register::Hisr,
            before | flags << FLAG_SHIFTS[self.id.stream - 4],
        );
        self.flagged = true;
    }

    fn remember(&mut self, registers: &RegisterFile) {
        self.kept = ALL.map(|row| self.held(registers, row));
        self.enabled = self.kept[Row::Control as usize] & EN != 0;
    }

    /// Handles a write to one of its registers; returns false to leave it to the emulator's stream.
    pub(super) fn write(
        &mut self,
        row: Row,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) -> bool {
        if self.running.is_none() {
            if row == Row::Count {
                self.programmed = self.held(registers, Row::Count) & NDT;
                self.remaining.0 = None;
            }
            if row == Row::Memory0 {
                self.remaining.1 = None;
            }
            let starts = !self.enabled && self.held(registers, Row::Control) & EN != 0;
            let is_ring = starts && self.start(registers, context);
            self.remember(registers);
            return is_ring;
        }
        let kept = self.kept[row as usize];
        match row {
            Row::Control => self.set(registers, row, !OPEN, kept),
            Row::Fifo => self.set(registers, row, !FEIE, kept),
            Row::Count => self.count(registers),
            _ => registers.set(self.register(row), kept),
        }
        if self.held(registers, Row::Control) & EN == 0 {
            self.stop(registers, TCIF);
        }
        self.flagged = true;
        self.remember(registers);
        true
    }

    /// Starts, unless the stream is set up for something other than a ring.
    fn start(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) -> bool {
        let control = self.held(registers, Row::Control);
        let fifo = self.held(registers, Row::Fifo);
        let (direction, size) = (control >> 6 & 3, control >> 11 & 3);
        let is_ring = control & (CIRC | MINC | OTHER_MODES | DMEIE) == CIRC | MINC
            && direction < 2
            && size < 3
            && control >> 25 & 7 == self.id.channel
            && fifo & (DMDIS | FEIE) == 0
            && self.programmed > 0;
        if !is_ring {
            return false;
        }
        // It starts only with its flags cleared (RM0383 section 9.5.5).
        if registers.get(Register::Hisr) >> FLAG_SHIFTS[self.id.stream - 4] & FLAGS != 0 {
            self.set(registers, Row::Control, EN, 0);
            return true;
        }
        let forced = control & !(NOT_DIRECT | 3 << 13) | size << 13;
        registers.set(self.register(Row::Control), forced);
        let bytes = 1 << size;
        let total = self.programmed * bytes;
        let (remaining, next) = std::mem::take(&mut self.remaining);
        let remaining = remaining
            .filter(|_| self.streams.keeps_count)
            .unwrap_or(total);
        let next = next.filter(|_| self.streams.keeps_address);
        self.running = Some(Running {
            from_memory: direction == 1,
            bytes,
            total,
            to_load: remaining,
            to_store: remaining,
            memory_at: next.unwrap_or(self.held(registers, Row::Memory0)),
            held: None,
            outstanding: false,
            halved: remaining * 2 <= total,
        });
        self.count(registers);
        self.report(registers);
        self.pump(registers, context);
        true
    }

    fn stop(&mut self, registers: &mut RegisterFile, flags: u64) {
        if let Some(run) = self.running.take() {
            // An item that was read ahead is dropped and will be read again.
            let ahead = run
                .held
                .filter(|_| run.from_memory)
                .map_or(0, |_| run.bytes);
            self.remaining = (Some(run.to_store), Some(run.memory_at - ahead));
        }
        self.flag(registers, flags);
        self.set(registers, Row::Control, EN, 0);
        self.set(registers, Row::Fifo, FS, FS_EMPTY << 3);
    }

    /// Updates NDTR, which follows the peripheral port.
    fn count(&self, registers: &mut RegisterFile) {
        let Some(run) = self.running else { return };
        let remaining = if run.from_memory {
            run.to_store
        } else {
            run.to_load
        };
        self.set(registers, Row::Count, NDT, remaining / run.bytes);
    }

    fn report(&self, registers: &mut RegisterFile) {
        let Some(run) = self.running else { return };
        let level = run.held.map_or(FS_EMPTY, |_| run.bytes / 4);
        self.set(registers, Row::Fifo, FS, level << 3);
    }

    fn pump(&mut self, registers: &mut RegisterFile, context: &mut DeviceContext<'_>) {
        let Some(mut run) = self.running else { return };
        let (load, store) = (2 * self.id.stream as u64, 2 * self.id.stream as u64 + 1);
        let peripheral_at = self.held(registers, Row::Peripheral);
        let (from, to) = if run.from_memory {
            (run.memory_at, peripheral_at)
        } else {
            (peripheral_at, run.memory_at)
        };
        let width = match run.bytes {
            1 => Width::W8,
            2 => Width::W16,
            _ => Width::W32,
        };
        if run.outstanding {
            return;
        }
        let may_store = run.to_store > 0 && (self.requested || !run.from_memory);
        if let Some(item) = run.held.take_if(|_| may_store) {
            context.write_to(to, width, item, store);
        } else if run.held.is_none()
            && run.to_load >= run.bytes
            && (self.requested || run.from_memory)
        {
            context.read_from(from, width, load);
        } else {
            return;
        }
        run.outstanding = true;
        self.running = Some(run);
        self.report(registers);
    }

    /// The peripheral raises or withdraws its request.
    pub(super) fn request(
        &mut self,
        requested: bool,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        self.requested = requested;
        if requested {
            self.pump(registers, context);
        }
    }

    /// An access has completed: a store, or a load of `value`.
    pub(super) fn answered(
        &mut self,
        stored: bool,
        value: u64,
        registers: &mut RegisterFile,
        context: &mut DeviceContext<'_>,
    ) {
        let Some(mut run) = self.running.filter(|run| run.outstanding) else {
            return;
        };
        run.outstanding = false;
        // Only the memory address increments.
        if stored != run.from_memory {
            run.memory_at += run.bytes;
        }
        let mut flags = 0;
        if stored {
            run.to_store -= run.bytes;
            if !run.halved && (run.total - run.to_store) * 2 >= run.total {
                run.halved = true;
                flags |= HTIF;
            }
            if run.to_store == 0 {
                flags |= TCIF;
                (run.to_load, run.to_store, run.halved) = (run.total, run.total, false);
                run.memory_at = self.held(registers, Row::Memory0);
            }
            flags |= u64::from(self.streams.fifo_errors) * FEIF;
        } else {
            run.held = Some(value);
            run.to_load -= run.bytes;
        }
        self.running = Some(run);
        if flags != 0 {
            self.flag(registers, flags);
        }
        self.report(registers);
        self.count(registers);
        self.pump(registers, context);
    }

    /// The bus has refused an access, which switches the stream off.
    pub(super) fn refused(&mut self, registers: &mut RegisterFile) {
        self.stop(registers, TEIF);
        self.remember(registers);
    }

    pub(super) fn reset(&mut self) {
        let requested = self.requested;
        *self = Self::new(self.id, self.streams);
        self.requested = requested;
    }
}

/// A ring that waits for its next request, with the data for moving many items at once.
#[derive(Clone, Copy, Debug)]
pub(super) struct IdleRing {
    pub(super) from_memory: bool,
    pub(super) bytes: u64,
    /// Its start in memory, and its number of items.
    pub(super) base: u64,
    pub(super) items: u64,
    /// The item to be moved next.
    pub(super) next: u64,
    /// The item read from memory ahead of its request.
    pub(super) held: Option<u64>,
    /// Items until the next interrupt: the last one's request raises it.
    pub(super) to_interrupt: Option<u64>,
    /// Address of the peripheral's register.
    pub(super) peripheral_at: u64,
}

impl Ring {
    /// The state of a ring that is running and waits for its next request, else none.
    pub(super) fn idle(&self, registers: &RegisterFile) -> Option<IdleRing> {
        let run = self
            .running
            .filter(|run| !run.outstanding && !self.requested)?;
        if run.held.is_some() != run.from_memory {
            return None;
        }
        let remaining = run.to_store / run.bytes;
        let items = run.total / run.bytes;
        let control = self.held(registers, Row::Control);
        // Half is reached, as for the flag, when twice the stored bytes are at least all bytes.
        let half = items.div_ceil(2);
        let next = items - remaining;
        let to_half = (control & HTIE != 0).then_some(if next < half {
            half - next
        } else {
            remaining + half
        });
        let to_end = (control & TCIE != 0).then_some(remaining);
        Some(IdleRing {
            from_memory: run.from_memory,
            bytes: run.bytes,
            base: self.held(registers, Row::Memory0),
            items,
            next,
            held: run.held,
            to_interrupt: to_half.into_iter().chain(to_end).min(),
            peripheral_at: self.held(registers, Row::Peripheral),
        })
    }

    /// Advances by `items` that were moved without it. `held` is the item that is read ahead after them.
    pub(super) fn skip(&mut self, items: u64, held: Option<u64>, registers: &mut RegisterFile) {
        let Some(mut run) = self.running.filter(|_| items > 0) else {
            return;
        };
        let all = run.total / run.bytes;
        let half = all.div_ceil(2);
        let from = all - run.to_store / run.bytes;
        let to = from + items;
        let mut flags = u64::from(self.streams.fifo_errors) * FEIF;
        if from < half && to >= half || to >= all + half {
            flags |= HTIF;
        }
        if to >= all {
            flags |= TCIF;
        }
        let at = to % all;
        run.to_store = (all - at) * run.bytes;
        run.halved = at >= half;
        let ahead = u64::from(run.from_memory);
        run.to_load = run.to_store - ahead * run.bytes;
        run.memory_at = self.held(registers, Row::Memory0) + (at + ahead) * run.bytes;
        run.held = held;
        self.running = Some(run);
        if flags != 0 {
            self.flag(registers, flags);
        }
        self.report(registers);
        self.count(registers);
    }
}
