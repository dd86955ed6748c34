//! One scenario on one machine.

use std::fmt::Write;
use std::sync::{Arc, Mutex};

use client::error::ClientError;
use client::link::Link;
use client::{Device, Unobserved};
use protocol::error::Refusal;
use protocol::settings::{FactoryReset, GetSetting, Setting, SettingKey};
use protocol::system::{Acknowledge, DeviceKind, Urgent};
use protocol::table::{Endpoint, Request, Response};

use super::line::{KeptLine, Sent, locked};
use super::scenario::{Dice, Happening};
use super::{Answer, Kept, Restart, Tally, Victim};
use crate::bench::{Bench, BenchError};
use crate::emulator::CutAt;
use crate::link::VirtualLink;
use crate::plants::capsule::Defect;
use crate::sabotage::{Misbehaviour, NOWHERE, Sabotage};

const MS: u64 = 1_000_000;
/// Time in which a disturbed machine need not answer, ns: a request that writes is sent for 3 s.
const EXCUSED_NS: u64 = 3_500 * MS;
/// Time from a reset to the first use of the link, us.
const START_US: u64 = 300_000;
/// Longest time until a task that misbehaves is ended, ns: watchdog and its last feeding, then the start.
const ENDED_NS: u64 = 1_800 * MS;
/// Longest time that anything may go on at the end, ns.
const ENDS_NS: u64 = 90_000 * MS;
/// Time of the last frame under way, and of the firmware's look at its clock, ns.
const NOTICED_NS: u64 = 60 * MS;
/// Least battery that keeps chip and sensors alive, mV.
const SOUND_MV: f64 = 3_200.0;

/// Interrupt enables of TIM1, and that of its break (RM0383 section 12.4.4).
const TIM1_DIER: u32 = 0x4001_000C;
const BIE: u32 = 1 << 7;

/// Why a trial ended early.
enum End {
    Bench(BenchError),
    Broken(String),
}

impl From<BenchError> for End {
    fn from(why: BenchError) -> Self {
        Self::Bench(why)
    }
}

impl From<String> for End {
    fn from(what: String) -> Self {
        Self::Broken(what)
    }
}

/// A request of any row of the table.
struct Any(Request);

impl Endpoint for Any {
    type Response = Response;

    fn into_request(self) -> Request {
        self.0
    }

    fn from_response(response: Response) -> Option<Response> {
        Some(response)
    }
}

struct Trial<M: Victim> {
    bench: Bench<M::Board>,
    device: Device,
    sent: Arc<Mutex<Sent>>,
    judge: M,
    kept: Kept,
    nonce: u32,
    /// A session is open.
    is_open: bool,
    /// The machine was restarted since its settings were last compared.
    has_restarted: bool,
    /// Time up to which the machine need not answer, ns.
    excused_ns: u64,
    /// Numbers of the last bytes with a fault: of the host, of the machine.
    bad_bytes: (u64, u64),
    /// Resets that were seen.
    resets: usize,
    /// When a task began to misbehave, ns.
    sabotaged_ns: Option<u64>,
    /// An address without memory was called.
    called_nowhere: bool,
    /// Until then the clock may restart the machine, ns.
    clock_ns: u64,
    /// The cell may be too weak for the chip.
    is_weak: bool,
    tally: Tally,
    story: String,
}

/// The tally of a trial, or the rule that was broken and the story.
pub(super) type Ended = Result<Tally, (String, String)>;

/// Runs a scenario.
///
/// # Errors
/// The bench failed.
pub(super) fn run<M: Victim>(
    dice: &mut Dice,
    happenings: &[Happening],
) -> Result<Ended, BenchError> {
    let bench = M::start(dice)?;
    let sent = Arc::default();
    let link = KeptLine::new(VirtualLink::new(&bench, "a tortured machine"), &sent);
    let mut trial = Trial::<M> {
        device: Device::new(Box::new(link), 1),
        sent,
        judge: M::default(),
        kept: Kept::new(M::KIND),
        nonce: 0,
        is_open: false,
        has_restarted: true,
        excused_ns: 0,
        bad_bytes: (0, 0),
        resets: 0,
        sabotaged_ns: None,
        called_nowhere: false,
        clock_ns: 0,
        is_weak: false,
        tally: Tally::default(),
        story: String::new(),
        bench,
    };
    let ended = trial.quicken().and_then(|()| {
        let mut each = happenings.iter();
        each.try_for_each(|happening| trial.happen(happening))?;
        trial.examine()
    });
    match ended {
        Ok(()) => Ok(Ok(trial.tallied())),
        Err(End::Bench(why)) => Err(why),
        Err(End::Broken(what)) => {
            let log = trial.bench.log()?;
            Ok(Err((what, format!("{}{log}", trial.story))))
        }
    }
}

impl<M: Victim> Trial<M> {
    fn now_ns(&self) -> u64 {
        self.bench.now_ns()
    }

    fn tallied(&self) -> Tally {
        let mut tally = self.tally.clone();
        let which = usize::from(M::KIND != DeviceKind::Rig);
        tally.scenarios[which] = 1;
        tally.judged[which] = self.judge.judged();
        tally.virtual_ns = self.now_ns();
        tally
    }

    /// Looks at the machine: pins, plant, resets.
    fn see(&mut self) -> Result<(), End> {
        self.judge.see(&self.bench)??;
        let now_ns = self.now_ns();
        let bus = self.bench.bus()?;
        for (at_ns, cause) in bus.resets.iter().skip(self.resets) {
            if self.sabotaged_ns.take().is_some() {
                self.restarted(Restart::Fault);
            } else if *at_ns < self.clock_ns {
                self.restarted(Restart::Clock);
            } else {
                return Err(format!("a reset that nobody asked for: {cause}").into());
            }
        }
        self.resets = bus.resets.len();
        let nowhere = format!("{NOWHERE:x}");
        let gap = |gap: &&String| !(self.called_nowhere && gap.contains(&nowhere));
        if let Some(gap) = bus.gaps.iter().find(gap) {
            return Err(gap.clone().into());
        }
        if self
            .sabotaged_ns
            .is_some_and(|at_ns| now_ns > at_ns + ENDED_NS)
        {
            return Err("a task that misbehaves was not ended".to_owned().into());
        }
        Ok(())
    }

    fn restarted(&mut self, how: Restart) {
        self.tally.restarts[how as usize] += 1;
        self.judge.restarted(how);
        (self.is_open, self.has_restarted) = (false, true);
        self.excuse();
    }

    fn excuse(&mut self) {
        self.excused_ns = self.now_ns() + EXCUSED_NS;
    }

    /// Whether the machine may leave a request unanswered now.
    fn is_excused(&mut self) -> Result<bool, End> {
        let counts = self.bench.visit(|visit| visit.serial().counts())?;
        if counts.0 <= self.bad_bytes.0 || counts.1 <= self.bad_bytes.1 {
            self.excuse();
        }
        let now_ns = self.now_ns();
        Ok(now_ns < self.excused_ns.max(self.clock_ns)
            || self.sabotaged_ns.is_some()
            || self.is_weak)
    }

    /// A request was not answered, or the session is over.
    fn unanswered(&mut self, error: &ClientError, excused: bool) -> Result<(), End> {
        let _ = writeln!(self.story, "    {error}");
        self.is_open = false;
        let over = matches!(error, ClientError::SessionLost { .. });
        if over || excused || self.is_excused()? {
            return Ok(());
        }
        Err(format!("it hangs: {error}").into())
    }

    /// Opens a session if there is none. Whether there is one.
    fn greet(&mut self) -> Result<bool, End> {
        if !self.is_open {
            self.nonce += 1;
            let excused = self.is_excused()?;
            match self.device.hello(self.nonce) {
                Ok(_) => self.is_open = true,
                Err(error) => self.unanswered(&error, excused)?,
            }
            locked(&self.sent).new.clear();
            self.see()?;
        }
        if self.is_open && self.has_restarted {
            self.compare_settings()?;
        }
        Ok(self.is_open)
    }

    /// Compares all settings with what was acknowledged.
    fn compare_settings(&mut self) -> Result<(), End> {
        for key in SettingKey::of(M::KIND) {
            let excused = self.is_excused()?;
            match self.device.call(GetSetting { key }) {
                Ok(Setting { value, .. }) if self.kept.found(key, value) => {}
                Ok(Setting { value, .. }) => {
                    return Err(format!("a setting is lost: {} is {value}", key.name()).into());
                }
                Err(error) => return self.unanswered(&error, excused),
            }
            self.tally.settings += 1;
        }
        self.has_restarted = false;
        Ok(())
    }

    fn ask(&mut self, request: &Request) -> Result<(Answer, Option<Refusal>), End> {
        if !self.greet()? {
            return Ok((Answer::Unknown, None));
        }
        self.see()?;
        let excused = self.is_excused()?;
        self.judge.order(request, &self.kept);
        locked(&self.sent).new.clear();
        let (answer, refusal) = match self.device.call(Any(request.clone())) {
            Ok(_) => (Answer::Done, None),
            Err(ClientError::Refused { refusal, .. }) => (Answer::Refused, Some(refusal)),
            Err(error) => {
                self.unanswered(&error, excused)?;
                (Answer::Unknown, None)
            }
        };
        if answer != Answer::Unknown {
            locked(&self.sent).answered();
        }
        let _ = writeln!(self.story, "    {answer:?} {refusal:?}");
        self.tally.answers[answer as usize] += 1;
        if answer == Answer::Done {
            *self.tally.done.entry(request.name()).or_default() += 1;
        }
        self.judge.see(&self.bench)??;
        self.judge.answered(request, answer)?;
        self.see()?;
        self.kept.answered(request, answer);
        Ok((answer, refusal))
    }

    /// The host keeps the link alive.
    fn wait(&mut self, us: u64) -> Result<(), End> {
        let end_us = self.now_ns() / 1_000 + us;
        while self.now_ns() / 1_000 < end_us {
            let left_us = (end_us - self.now_ns() / 1_000).min(M::PIECE_US);
            if self.is_open {
                let excused = self.is_excused()?;
                if let Err(error) = self.device.idle(left_us, &mut Unobserved) {
                    self.unanswered(&error, excused)?;
                }
            } else {
                self.bench.advance_us(left_us)?;
            }
            self.see()?;
        }
        Ok(())
    }

    fn stop(&mut self, urgent: Urgent) -> Result<(), End> {
        let excused = self.is_excused()?;
        match self.device.urgent(urgent) {
            Ok(()) => {
                self.see()?;
                self.judge.stopped(urgent);
                self.tally.stops += 1;
                Ok(())
            }
            Err(error) => self.unanswered(&error, excused),
        }
    }

    fn send(&mut self, bytes: &[u8]) -> Result<(), End> {
        let mut line = VirtualLink::new(&self.bench, "another hand on the line");
        line.send(bytes).map_err(|why| End::Broken(why.to_string()))
    }

    fn cut_power(&mut self, off_us: u64) -> Result<(), End> {
        self.see()?;
        self.bench.power_cycle(off_us)?;
        self.judge.see(&self.bench)??;
        (self.sabotaged_ns, self.clock_ns) = (None, 0);
        self.restarted(Restart::Power);
        self.bench.advance_us(START_US)?;
        self.see()
    }

    fn happen(&mut self, happening: &Happening) -> Result<(), End> {
        let now_ns = self.now_ns();
        let _ = writeln!(self.story, "{:>10} us  {happening:?}", now_ns / 1_000);
        self.tally.happenings += 1;
        self.see()?;
        match happening {
            Happening::Wait(us) => self.wait(*us)?,
            Happening::Silence(us) => self.fall_silent(*us)?,
            Happening::Hello => {
                self.is_open = false;
                self.greet()?;
            }
            Happening::Ask(request) => drop(self.ask(request)?),
            Happening::Stop(urgent) => self.stop(*urgent)?,
            Happening::Again(back) => self.send_again(*back)?,
            Happening::Twice(frames) => locked(&self.sent).twice = *frames,
            Happening::Noise(bytes) => {
                self.send(bytes)?;
                self.excuse();
            }
            Happening::Bytes(faults) => self.garble(faults)?,
            Happening::Reset => {
                self.bench.reset()?;
                self.judge.see(&self.bench)??;
                self.resets = self.bench.bus()?.resets.len();
                self.sabotaged_ns = None;
                self.restarted(Restart::Pin);
                self.bench.advance_us(START_US)?;
            }
            Happening::PowerCut(off_us) => self.cut_power(*off_us)?,
            Happening::CutStore(setting, at, number) => self.cut_store(*setting, *at, *number)?,
            Happening::HoldUp(us) => {
                let us = *us;
                self.bench.visit(move |visit| visit.hold_up(us))?;
                self.excuse();
            }
            Happening::Clock(back_us) => self.stop_clock(back_us * 1_000)?,
            Happening::Task(client, misbehaviour) => {
                let sabotage = Sabotage::new(&M::image(), *client, *misbehaviour)?;
                self.bench.visit(move |visit| sabotage.apply(visit))?;
                self.called_nowhere |= *misbehaviour == Misbehaviour::Fault;
                self.sabotaged_ns = Some(now_ns);
            }
            Happening::Press => {
                self.judge.pressed(&self.kept);
                self.inflict(happening)?;
                self.wait(60_000)?;
            }
            Happening::Rig(_, action) => {
                self.judge.acts(action);
                self.inflict(happening)?;
            }
            Happening::Capsule(_, defect) => {
                self.judge.suffers(defect);
                self.is_weak = match defect {
                    Defect::Battery(mv) => *mv < SOUND_MV,
                    Defect::Weak(_) | Defect::Collapse | Defect::Tired(_) => true,
                    _ => self.is_weak,
                };
                self.inflict(happening)?;
            }
        }
        self.see()
    }

    /// Stops the external clock for this time. The emulator raises no NMI, and the break, by which the rig notices it as
    /// well, is masked from an opening of the E-stop loop to its acknowledgement: the clock does not stop then.
    fn stop_clock(&mut self, back_ns: u64) -> Result<(), End> {
        let stops = self.bench.visit(move |visit| {
            let stops = visit
                .register(TIM1_DIER)
                .is_some_and(|bits| bits & BIE != 0);
            if stops {
                visit.fail_hse(Some(back_ns));
            }
            stops
        })?;
        if stops {
            self.clock_ns = self.now_ns() + back_ns + EXCUSED_NS;
        }
        Ok(())
    }

    /// The host is gone.
    fn fall_silent(&mut self, us: u64) -> Result<(), End> {
        let timeout_ms = u64::from(self.kept.most(SettingKey::LinkTimeoutMs));
        self.judge.gone(timeout_ms * MS + NOTICED_NS);
        let mut left_us = us;
        while left_us > 0 {
            let piece_us = left_us.min(M::PIECE_US);
            self.bench.advance_us(piece_us)?;
            self.see()?;
            left_us -= piece_us;
        }
        self.judge.back();
        Ok(())
    }

    /// An answered request arrives twice again: the last one, or one before it.
    fn send_again(&mut self, back: u32) -> Result<(), End> {
        let frame = {
            let sent = locked(&self.sent);
            let count = sent.answered.len();
            let which = count.checked_sub(back as usize);
            which.and_then(|which| sent.answered.get(which)).cloned()
        };
        match frame {
            Some(frame) => self.send(&[&frame[..], &frame[..]].concat()),
            None => Ok(()),
        }
    }

    /// Cuts the supply within a change of a setting.
    fn cut_store(&mut self, setting: Setting, at: CutAt, number: u64) -> Result<(), End> {
        if self.greet()? {
            let before = self.kept.clone();
            self.bench.visit(move |visit| {
                let done = visit.flash_operations();
                visit.cut_flash(at, done + number);
            })?;
            self.excuse();
            self.ask(&Request::SetSetting(setting))?;
            if self.bench.visit(|visit| visit.flash_is_cut())? {
                // Whatever the machine answered, the flash has the old value or the new one.
                self.kept = before;
                self.kept
                    .change(setting.key, setting.value, Answer::Unknown);
            }
        }
        self.cut_power(1_000_000)
    }

    fn inflict(&mut self, happening: &Happening) -> Result<(), End> {
        let happening = happening.clone();
        self.bench.visit(move |visit| {
            let now_ns = visit.now_ns();
            M::inflict(visit.board(), now_ns, &happening);
        })?;
        Ok(())
    }

    fn garble(&mut self, faults: &[(bool, u64, crate::serial::ByteFault)]) -> Result<(), End> {
        let faults = faults.to_vec();
        self.bad_bytes = self.bench.visit(move |visit| {
            let mut serial = visit.serial();
            let (taken, sent) = serial.counts();
            let mut last = (taken, sent);
            for (to_machine, ahead, fault) in faults {
                if to_machine {
                    serial.corrupt_to_machine(taken + ahead, fault);
                    last.0 = last.0.max(taken + ahead);
                } else {
                    serial.corrupt_from_machine(sent + ahead, fault);
                    last.1 = last.1.max(sent + ahead);
                }
            }
            last
        })?;
        Ok(())
    }

    /// Makes settings that save time.
    fn quicken(&mut self) -> Result<(), End> {
        for (key, value) in M::QUICK {
            let (key, value) = (*key, *value);
            self.must(&Request::SetSetting(Setting { key, value }))?;
        }
        Ok(())
    }

    /// A request that has to be carried out now.
    fn must(&mut self, request: &Request) -> Result<(), End> {
        match self.ask(request)? {
            (Answer::Done, _) => Ok(()),
            (_, refusal) => Err(format!("{} at the end: {refusal:?}", request.name()).into()),
        }
    }

    /// Waits until nothing goes on any more.
    fn rest(&mut self) -> Result<(), End> {
        let end_ns = self.now_ns() + ENDS_NS;
        loop {
            self.wait(100_000)?;
            if self.greet()? {
                match M::is_at_rest(&mut self.device) {
                    Ok(true) => return Ok(()),
                    Ok(false) => {}
                    Err(error) => self.unanswered(&error, false)?,
                }
            }
            if self.now_ns() > end_ns {
                return Err("it hangs: something never ends".to_owned().into());
            }
        }
    }

    /// With everything in order the machine answers, has its settings and works.
    fn examine(&mut self) -> Result<(), End> {
        self.story.push_str("everything in order\n");
        let end_ns = self.now_ns() + ENDS_NS;
        while !self.judge.cure(&self.bench)? {
            self.wait(100_000)?;
            if self.now_ns() > end_ns {
                return Err("it hangs: a motion never ends".to_owned().into());
            }
        }
        self.bench.visit(|visit| visit.serial().forget_faults())?;
        locked(&self.sent).twice = 0;
        (self.bad_bytes, self.is_weak) = ((0, 0), false);
        while self.is_excused()? {
            self.wait(100_000)?;
        }
        for _ in 0..2 {
            self.stop(Urgent::Stop)?;
            self.rest()?;
        }
        match self.ask(&Request::Acknowledge(Acknowledge))? {
            (Answer::Done, _) | (_, Some(Refusal::NothingToAcknowledge)) => {}
            (_, refusal) => return Err(format!("the fault stays: {refusal:?}").into()),
        }
        self.cut_power(1_000_000)?;
        // A capsule measures its offsets first.
        self.wait(2_000_000)?;
        self.excused_ns = 0;
        self.must(&Request::FactoryReset(FactoryReset))?;
        self.quicken()?;
        for request in M::exam() {
            self.must(&request)?;
            self.rest()?;
            self.wait(500_000)?;
            self.judge.passed(&request, &self.bench)?;
        }
        Ok(())
    }
}
