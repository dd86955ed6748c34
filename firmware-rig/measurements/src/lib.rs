//! Measurements that only a board can make, each with its expected range.
//!
//! The image `firmware-board` prints a line for each measurement, `cargo xtask board` reads and judges the lines. The
//! items are those of docs/silicon.md.
#![no_std]
#![forbid(unsafe_code)]

/// First word of each line with a value; the measurement's name and the value follow.
pub const MARK: &str = "measured";
/// The last line of the image.
pub const END: &str = "all measured";

/// How a value is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Base {
    /// Quantities.
    Decimal,
    /// Registers.
    Hexadecimal,
}

/// The values that agree with what is expected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Expected {
    /// From the first to the last of them.
    Within(u32, u32),
    /// Nothing is known; each value is a finding.
    Any(Base),
}

impl Expected {
    /// Whether a value agrees.
    #[must_use]
    pub const fn holds(self, value: u32) -> bool {
        match self {
            Self::Within(first, last) => first <= value && value <= last,
            Self::Any(_) => true,
        }
    }
}

/// Wires that a measurement needs besides the USB cable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wires {
    /// None.
    None,
    /// The pull-up of EN.
    EnablePullUp,
    /// The loop to ground.
    Loop,
    /// The loop to ground, and both jumpers from STEP.
    Jumpers,
}

impl Wires {
    /// The wires by their names on the board.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Wires::None => "-",
            Wires::EnablePullUp => "10 kohm D8-3.3 V",
            Wires::Loop => "D12-GND",
            Wires::Jumpers => "D12-GND, D2-A0, D2-A1",
        }
    }
}

/// Reads a line of the image: the measurement and its value.
#[must_use]
pub fn parse(line: &str) -> Option<(Measurement, u32)> {
    let mut words = line.split(MARK).nth(1)?.split_whitespace();
    let (name, value) = (words.next()?, words.next()?);
    let found = Measurement::ALL.into_iter().find(|one| one.name() == name);
    Some((found?, value.parse().ok()?))
}

macro_rules! measurements {
    ($($name:ident $item:literal $unit:literal $expected:expr, $wires:ident, $what:literal;)*) => {
        /// A measurement, in the order of the image.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[cfg_attr(feature = "defmt", derive(defmt::Format))]
        pub enum Measurement {
            $(#[doc = $what] $name,)*
        }

        impl Measurement {
            /// All of them.
            pub const ALL: [Self; [$($item),*].len()] = [$(Self::$name),*];

            /// Name, as in the image's lines.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self { $(Self::$name => stringify!($name),)* }
            }

            /// Description in one line.
            #[must_use]
            pub const fn what(self) -> &'static str {
                match self { $(Self::$name => $what,)* }
            }

            /// Item of docs/silicon.md.
            #[must_use]
            pub const fn item(self) -> &'static str {
                match self { $(Self::$name => $item,)* }
            }

            /// Unit of the value.
            #[must_use]
            pub const fn unit(self) -> &'static str {
                match self { $(Self::$name => $unit,)* }
            }

            /// The values that agree.
            #[must_use]
            pub const fn expected(self) -> Expected {
                match self { $(Self::$name => $expected,)* }
            }

            /// Wires that it needs.
            #[must_use]
            pub const fn wires(self) -> Wires {
                match self { $(Self::$name => Wires::$wires,)* }
            }
        }
    };
}

use Base::{Decimal, Hexadecimal};
use Expected::{Any, Within};

// Name, item, unit, expected, wires, what. The cycles expected are at most twice the bench's 121, 242 and
// 195, which rest on 65 instructions in 100 cycles; at 249.7 kHz a step has 400.
measurements! {
    UniqueNumber0 "-" "" Any(Hexadecimal), None, "the chip's unique number, bits 31 to 0";
    UniqueNumber1 "-" "" Any(Hexadecimal), None, "the unique number, bits 63 to 32";
    UniqueNumber2 "-" "" Any(Hexadecimal), None, "the unique number, bits 95 to 64";
    ChipRevision "Sources" "" Any(Hexadecimal), None, "DBGMCU_IDCODE: revision and device";
    EnableAtReset "7" "" Within(1, 1), EnablePullUp, "D8 before the firmware drives it";
    ExternalClockStart "2" "us" Within(0, 300_000), None, "from HSEON to HSERDY";
    OptionBytes "10" "" Any(Hexadecimal), None, "FLASH_OPTCR";
    BrownOutBits "10" "" Any(Decimal), None, "BOR_LEV of FLASH_OPTCR: 3 is off, 0 the highest level";
    WatchdogBySoftware "10" "" Within(1, 1), None, "WDG_SW of FLASH_OPTCR";
    StackGuard "18" "" Within(1, 1), None, "a store just below the RAM is a bus fault";
    TimerTicks "Beyond the errata" "ticks" Within(999_900, 1_000_100), None, "TIM5 in 1,000,000 cycles of the core (DWT)";
    WatchdogClock "14" "Hz" Within(17_000, 47_000), None, "LSI against the core's clock, by TIM5_CH4";
    BlockedCount "TIM1" "ticks" Within(0, 0), None, "TIM1_CNT 1 ms after ARR became 0 while it counted";
    BlockedUpdates "TIM1" "" Within(0, 0), None, "update events in 1 ms at ARR = 0";
    MoeReads "1" "reads" Within(1, 16), Loop, "reads of TIM1_BDTR until MOE shows";
    MoeCycles "1" "cycles" Any(Decimal), Loop, "cycles of the core until MOE shows, by DWT";
    BurstFirst "5" "ticks" Within(0, 200), Loop, "latest count at which a burst's first word shows after the update";
    BurstLast "5" "ticks" Within(0, 200), Loop, "latest count at which its last word shows";
    RepeatEdges "TIM1" "edges" Within(287, 287), Jumpers, "slots of 1, 2, 4, 8, 16 and 256 equal steps (RCR by burst)";
    RepeatExact "16" "intervals" Within(1, 286), Jumpers, "the same slots: intervals that are exact";
    RepeatWrong "TIM1" "intervals" Within(0, 0), Jumpers, "the same slots: intervals off by 2 ticks or more";
    StepAtEnd "TIM1" "" Within(0, 0), Loop, "STEP after the last pulse";
    CruiseMissing "13" "edges" Within(0, 0), Jumpers, "28.5 kHz: edges missing or too many, of 5,000 steps";
    CruiseExact "16" "intervals" Within(1, 4_999), Jumpers, "28.5 kHz: intervals that are exact";
    CruiseOff1 "16" "intervals" Any(Decimal), Jumpers, "28.5 kHz: intervals off by 1 tick";
    CruiseOff2 "16" "intervals" Within(0, 0), Jumpers, "28.5 kHz: intervals off by 2 ticks";
    CruiseWrong "16" "intervals" Within(0, 0), Jumpers, "28.5 kHz: intervals off by more";
    CruiseLost "16" "" Within(0, 0), Jumpers, "28.5 kHz: polls that found a lost capture";
    CruiseCycles "12" "cycles" Within(1, 250), Jumpers, "28.5 kHz: cycles of motion's code per step, by DWT";
    RampMissing "13" "edges" Within(0, 0), Jumpers, "ramps to 125 kHz: edges missing or too many, of 10,000 steps";
    RampExact "16" "intervals" Within(1, 9_999), Jumpers, "ramps to 125 kHz: intervals that are exact";
    RampOff1 "16" "intervals" Any(Decimal), Jumpers, "ramps to 125 kHz: intervals off by 1 tick";
    RampOff2 "16" "intervals" Within(0, 0), Jumpers, "ramps to 125 kHz: intervals off by 2 ticks";
    RampWrong "16" "intervals" Within(0, 0), Jumpers, "ramps to 125 kHz: intervals off by more";
    RampLost "16" "" Within(0, 0), Jumpers, "ramps to 125 kHz: polls that found a lost capture";
    RampCycles "12" "cycles" Within(1, 500), Jumpers, "ramps to 125 kHz: cycles of motion's code per step, by DWT";
    FastMissing "13" "edges" Within(0, 0), Jumpers, "249.7 kHz: edges missing or too many, of 20,000 steps";
    FastExact "16" "intervals" Within(1, 19_999), Jumpers, "249.7 kHz: intervals that are exact";
    FastOff1 "16" "intervals" Any(Decimal), Jumpers, "249.7 kHz: intervals off by 1 tick";
    FastOff2 "16" "intervals" Within(0, 0), Jumpers, "249.7 kHz: intervals off by 2 ticks";
    FastWrong "16" "intervals" Within(0, 0), Jumpers, "249.7 kHz: intervals off by more";
    FastLost "16" "" Within(0, 0), Jumpers, "249.7 kHz: polls that found a lost capture";
    FastCycles "12" "cycles" Within(1, 390), Jumpers, "249.7 kHz: cycles of motion's code per step, by DWT";
    TimerResets "20" "" Within(0, 0), None, "resets of TIM1 at the end of these paths";
    DmaErrors "16" "" Within(0, 0), None, "errors of DMA in these paths (TEIF, DMEIF)";
    FifoErrors "16" "" Any(Decimal), None, "underruns of the streams' FIFOs in these paths, by poll: any number is right";
    EraseTime "4, 14" "us" Within(100_000, 500_000), None, "the longer of two erases of a settings sector, 16 KiB";
    WordTime "4" "us" Within(1, 100), None, "a word written to flash, mean of 64";
    CutBursts "5" "" Any(Decimal), None, "bursts cut in two by a withdrawn request, of 200 tries";
    CutBurstShift "5" "registers" Any(Decimal), None, "how far the burst after one that was cut is shifted, at most";
}
