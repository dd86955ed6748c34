//! Draws the panels on a screen of at least 80 columns and 24 rows.

use std::time::Instant;

use client::{decimal, identity, visible};
use lab::operations::panel::{Contact, Notice, Panel, left_s, millimetres, run_text};
use lab::trials::progress;
use protocol::capsule::{CapsuleState, CapsuleStatus};
use protocol::rig::{RigState, RigStatus};
use ratatui_core::buffer::Buffer;
use ratatui_core::layout::Rect;
use ratatui_core::style::{Color, Style};

/// Minimum columns and rows.
const LEAST: (u16, u16) = (80, 24);

/// Help on the keys.
const KEYS: &str = " h hold   r resume   s STOP   e EMERGENCY STOP   q leave";

/// Full scale of the bars: thread wound, um, and motor current, mA. A healthy capsule stays below both.
const FULL_THREAD_UM: i32 = 30_000;
const FULL_CURRENT_MA: u16 = 250;

/// Look of the screen.
#[derive(Clone, Copy, Debug)]
pub struct Look {
    /// Colours may be used.
    pub colours: bool,
    /// The terminal shows characters beyond ASCII.
    pub unicode: bool,
}

/// Characters for lines and bars.
struct Glyphs {
    line: char,
    side: char,
    corners: [char; 4],
    full: char,
    empty: char,
    carriage: &'static str,
    ends: (char, char),
}

impl Look {
    /// The look that the user's environment asks for.
    #[must_use]
    pub fn of_environment() -> Self {
        let set = |name: &str| std::env::var_os(name).is_some_and(|value| !value.is_empty());
        Self {
            colours: !set("NO_COLOR"),
            unicode: progress::is_unicode(),
        }
    }

    fn glyphs(self) -> Glyphs {
        if self.unicode {
            Glyphs {
                line: '─',
                side: '│',
                corners: ['┌', '┐', '└', '┘'],
                full: '█',
                empty: '░',
                carriage: "[◉◉]",
                ends: ('├', '┤'),
            }
        } else {
            Glyphs {
                line: '-',
                side: '|',
                corners: ['+'; 4],
                full: '#',
                empty: '.',
                carriage: "[OO]",
                ends: ('|', '|'),
            }
        }
    }

    fn style(self, tone: Tone) -> Style {
        let style = Style::new();
        let colour = match tone {
            Tone::Plain => return style,
            Tone::Good => Color::Green,
            Tone::Moving => Color::Cyan,
            Tone::Waiting => Color::Yellow,
            Tone::Bad => Color::Red,
            Tone::Strong => return style.bold(),
            Tone::Bar => return style.reversed(),
        };
        let style = style.bold();
        if self.colours {
            style.fg(colour)
        } else {
            style
        }
    }
}

#[derive(Clone, Copy)]
enum Tone {
    Plain,
    Strong,
    Bar,
    Good,
    Moving,
    Waiting,
    Bad,
}

/// A part of the screen to write on.
struct Sheet<'a> {
    buffer: &'a mut Buffer,
    area: Rect,
    look: Look,
}

impl Sheet<'_> {
    /// Writes a text from a column on and clips it at the edge.
    fn put(&mut self, x: u16, y: u16, text: &str, tone: Tone) {
        if y < self.area.height && x < self.area.width {
            let width = usize::from(self.area.width - x);
            let style = self.look.style(tone);
            let (x, y) = (self.area.x + x, self.area.y + y);
            let text = visible::line(text);
            self.buffer.set_stringn(x, y, text, width, style);
        }
    }

    /// Writes a text over several rows, broken at words. Returns the number of rows.
    fn wrap(&mut self, y: u16, rows: u16, text: &str, tone: Tone) -> u16 {
        let mut shown = visible::wrapped(text, self.area.width.into(), "");
        let is_cut = shown.len() > usize::from(rows);
        shown.truncate(rows.into());
        if is_cut && let Some(last) = shown.last_mut() {
            let kept = usize::from(self.area.width).saturating_sub(3);
            *last = last.chars().take(kept).collect::<String>() + "...";
        }
        for (row, line) in (y..).zip(&shown) {
            self.put(0, row, line, tone);
        }
        shown.len() as u16
    }

    /// Draws a frame with a title at the top and one at the bottom. Returns its inside.
    fn frame(&mut self, title: &str, bottom: &str, tone: Tone) -> Sheet<'_> {
        let glyphs = self.look.glyphs();
        let (width, height) = (self.area.width, self.area.height);
        let line: String =
            std::iter::repeat_n(glyphs.line, width.saturating_sub(2).into()).collect();
        for (y, left, right) in [
            (0, glyphs.corners[0], glyphs.corners[1]),
            (
                height.saturating_sub(1),
                glyphs.corners[2],
                glyphs.corners[3],
            ),
        ] {
            self.put(0, y, &format!("{left}{line}{right}"), tone);
        }
        for y in 1..height.saturating_sub(1) {
            self.put(0, y, &glyphs.side.to_string(), tone);
            self.put(width.saturating_sub(1), y, &glyphs.side.to_string(), tone);
        }
        let room = usize::from(width.saturating_sub(6));
        for (y, title) in [(0, title), (height.saturating_sub(1), bottom)] {
            if !title.is_empty() {
                self.put(2, y, &format!(" {} ", cut(title, room)), tone);
            }
        }
        let area = Rect {
            x: self.area.x + 2,
            y: self.area.y + 1,
            width: width.saturating_sub(4),
            height: height.saturating_sub(2),
        };
        Sheet {
            buffer: self.buffer,
            area,
            look: self.look,
        }
    }

    /// Draws a bar of which `part` of `whole` is filled.
    fn bar(&mut self, x: u16, y: u16, width: u16, part: u64, whole: u64, tone: Tone) {
        let glyphs = self.look.glyphs();
        let cells = u64::from(width);
        let full = (part.min(whole) * cells + whole / 2) / whole.max(1);
        let text: String = (0..cells)
            .map(|cell| {
                if cell < full {
                    glyphs.full
                } else {
                    glyphs.empty
                }
            })
            .collect();
        self.put(x, y, &text, tone);
    }
}

/// Shortens a text to `room` characters.
fn cut(text: &str, room: usize) -> String {
    if text.chars().count() <= room {
        return text.to_owned();
    }
    text.chars()
        .take(room.saturating_sub(3))
        .collect::<String>()
        + "..."
}

/// Rows of each panel, including its frame.
const RIG_ROWS: u16 = 10;
const CAPSULE_ROWS: u16 = 8;

/// Draws everything; `at` is the present time.
pub fn draw(panels: &[Panel], look: Look, at: Instant, buffer: &mut Buffer) {
    let area = buffer.area;
    let mut sheet = Sheet { buffer, area, look };
    if area.width < LEAST.0 || area.height < LEAST.1 {
        return too_small(panels, &mut sheet, at);
    }
    let mut y = 0;
    for panel in panels {
        let rig = panel.kind == protocol::system::DeviceKind::Rig;
        let rows = if rig { RIG_ROWS } else { CAPSULE_ROWS };
        let area = Rect {
            x: 0,
            y,
            width: area.width,
            height: rows,
        };
        y += rows;
        let tone = match (&panel.contact, is_faulted(panel)) {
            (Contact::Lost(_), _) => Tone::Waiting,
            (_, true) => Tone::Bad,
            _ => Tone::Plain,
        };
        let mut piece = Sheet {
            buffer: sheet.buffer,
            area,
            look,
        };
        let title = format!("{} at {}", identity::kind_name(panel.kind), panel.place);
        let line = match &panel.contact {
            Contact::Window(owner) => format!("through {owner}"),
            Contact::Owned => "this program owns the line".to_owned(),
            Contact::Lost(_) => String::new(),
        };
        let mut inside = piece.frame(&title, &line, tone);
        match (&panel.contact, &panel.rig, &panel.capsule) {
            (Contact::Lost(why), ..) => {
                inside.put(0, 0, "NO CONTACT", Tone::Bad);
                inside.put(
                    12,
                    0,
                    "what it does is not known; tried again all the time",
                    Tone::Plain,
                );
                inside.wrap(1, rows - 3, why, Tone::Plain);
            }
            (_, Some(status), _) => rig_panel(panel, status, at, &mut inside),
            (_, _, Some(status)) => capsule_panel(panel, status, at, &mut inside),
            _ => inside.put(0, 0, "waiting for its status", Tone::Plain),
        }
    }
    let notices = notices(panels, area.width);
    let bottom = (area.height - 1)
        .saturating_sub(notices.len() as u16)
        .max(y);
    events(panels, y, bottom, &mut sheet);
    for (row, (text, tone)) in (bottom..area.height - 1).zip(notices) {
        sheet.put(1, row, &text, tone);
    }
    keys(&mut sheet, area.height - 1);
}

/// Draws the row of the keys.
fn keys(sheet: &mut Sheet<'_>, y: u16) {
    let width = usize::from(sheet.area.width);
    sheet.put(0, y, &format!("{KEYS:<width$}"), Tone::Bar);
}

/// Results of the keys, in rows.
fn notices(panels: &[Panel], width: u16) -> Vec<(String, Tone)> {
    let width = usize::from(width) - 2;
    let mut rows = vec![];
    for panel in panels {
        let (text, tone) = match &panel.notice {
            None => continue,
            Some(Notice::Done(text)) => (text, Tone::Good),
            Some(Notice::Bad(text)) => (text, Tone::Bad),
        };
        let text = format!("{}: {text}", identity::kind_name(panel.kind));
        let lines = visible::wrapped(&text, width, "").into_iter();
        rows.extend(lines.map(|line| (line, tone)));
    }
    rows
}

fn is_faulted(panel: &Panel) -> bool {
    let rig = panel.rig.and_then(|status| status.fault).is_some();
    rig || panel.capsule.and_then(|status| status.fault).is_some()
}

fn too_small(panels: &[Panel], sheet: &mut Sheet<'_>, at: Instant) {
    let (width, height) = (sheet.area.width, sheet.area.height);
    let text = format!(
        "This terminal has {width}x{height}; the dashboard needs {}x{}: enlarge it.",
        LEAST.0, LEAST.1
    );
    let keys = KEYS.trim();
    let mut y = sheet.wrap(0, height, &text, Tone::Strong);
    // Show the keys here, too, because they work.
    y += sheet.wrap(y, height.saturating_sub(y), keys, Tone::Bar);
    for panel in panels {
        y += sheet.wrap(y, height.saturating_sub(y), &panel.line(at), Tone::Plain);
    }
}

fn rig_tone(state: RigState) -> Tone {
    match state {
        RigState::Ready => Tone::Good,
        RigState::Running | RigState::Moving | RigState::Homing => Tone::Moving,
        RigState::Held | RigState::Stopping | RigState::Unhomed => Tone::Waiting,
        RigState::Faulted => Tone::Bad,
    }
}

fn rig_panel(panel: &Panel, status: &RigStatus, at: Instant, sheet: &mut Sheet<'_>) {
    let state = format!("{:?}", status.state).to_uppercase();
    sheet.put(0, 0, &state, rig_tone(status.state));
    let homed = match (status.fault, status.homed, status.needs_acknowledge) {
        (Some(_), true, _) => "acknowledge with `retrograde ack`",
        (Some(_), false, _) => "not homed; acknowledge with `retrograde ack`",
        (None, _, true) => "restarted after a failure: `retrograde ack`",
        (None, true, _) => "homed",
        (None, false, _) => "not homed: the position is not known",
    };
    sheet.put(12, 0, homed, Tone::Plain);
    track(status, sheet);
    let speed = match panel.speed_um_s(at) {
        None => "not known".to_owned(),
        Some(speed) => {
            let way = match speed {
                0 => "",
                1.. => ", away from home",
                _ => ", towards home",
            };
            let speed = i64::from(speed).unsigned_abs() as i64;
            format!("{} mm/s{way}", decimal::fixed(speed, 3))
        }
    };
    let position = millimetres(status.position_um);
    let numbers = format!("position {position:>8} mm     speed {speed}");
    sheet.put(0, 2, &numbers, Tone::Strong);
    if let Some(fault) = status.fault {
        let text = format!("FAULT: {fault}");
        sheet.wrap(3, 3, &text, Tone::Bad);
    } else if let Some(thousandths) = panel.run_thousandths() {
        let width = sheet.area.width / 3;
        let all = u64::from(status.strokes) * 1_000;
        sheet.bar(0, 4, width, thousandths, all, Tone::Moving);
        let left = left_s(status, thousandths);
        let left = left.map_or_else(String::new, |s| format!(", about {s} s left"));
        let text = format!("{}{left}", run_text(status));
        sheet.put(width + 2, 4, &text, Tone::Plain);
    } else if status.run > 0 {
        let text = format!("no run; the last one was run {}", status.run);
        sheet.put(0, 4, &text, Tone::Plain);
    }
    let open = |open: bool| if open { "OPEN" } else { "closed" };
    let inputs = format!(
        "home flag {}   far limit {}   E-stop loop {}",
        open(status.inputs.home_flag),
        open(status.inputs.far_limit),
        open(status.inputs.estop_loop),
    );
    sheet.put(0, 6, &inputs, Tone::Plain);
    link(panel, at, 7, sheet);
}

/// Carriage and rollers along the stroke.
fn track(status: &RigStatus, sheet: &mut Sheet<'_>) {
    let glyphs = sheet.look.glyphs();
    let stroke_mm = decimal::write(status.stroke_um.into(), 3);
    let right = format!(" {stroke_mm} mm");
    let width = usize::from(sheet.area.width).saturating_sub(2 + right.len());
    let carriage = glyphs.carriage.chars().count();
    let room = width.saturating_sub(2 + carriage) as i64;
    let stroke = i64::from(status.stroke_um).max(1);
    // Draw a position beyond the ends at the end. The number beside it is exact.
    let at = (i64::from(status.position_um) * room + stroke / 2) / stroke;
    let at = at.clamp(0, room) as usize;
    let mut line: Vec<char> = vec![glyphs.ends.0];
    line.extend(std::iter::repeat_n(glyphs.line, width.saturating_sub(2)));
    line.push(glyphs.ends.1);
    let line: String = line.into_iter().collect();
    sheet.put(0, 1, "0", Tone::Plain);
    sheet.put(2, 1, &line, Tone::Plain);
    sheet.put(2 + width as u16, 1, &right, Tone::Plain);
    if status.homed {
        let tone = rig_tone(status.state);
        sheet.put(3 + at as u16, 1, glyphs.carriage, tone);
    }
}

fn capsule_tone(state: CapsuleState) -> Tone {
    match state {
        CapsuleState::Unfolded | CapsuleState::Folded => Tone::Good,
        CapsuleState::Referencing
        | CapsuleState::Folding
        | CapsuleState::Unfolding
        | CapsuleState::Checking => Tone::Moving,
        CapsuleState::Unreferenced | CapsuleState::Stopped | CapsuleState::WasFolded => {
            Tone::Waiting
        }
        CapsuleState::Faulted => Tone::Bad,
    }
}

fn capsule_panel(panel: &Panel, status: &CapsuleStatus, at: Instant, sheet: &mut Sheet<'_>) {
    let state = format!("{:?}", status.state).to_uppercase();
    sheet.put(0, 0, &state, capsule_tone(status.state));
    let referenced = match (status.fault, status.referenced, status.needs_acknowledge) {
        (Some(_), ..) => "acknowledge with `retrograde ack`",
        (None, _, true) => "restarted after a failure: `retrograde ack`",
        (None, true, _) => "referenced",
        (None, false, _) => "not referenced",
    };
    sheet.put(14, 0, referenced, Tone::Plain);
    let battery = format!("battery {} V", decimal::fixed(status.battery_mv.into(), 3));
    let x = sheet.area.width.saturating_sub(battery.len() as u16);
    sheet.put(x, 0, &battery, Tone::Plain);
    let width = sheet.area.width.saturating_sub(34);
    let thread = status.thread_um.clamp(0, FULL_THREAD_UM);
    for (y, name, value, part, whole) in [
        (
            1,
            "thread",
            format!("{} mm", millimetres(status.thread_um)),
            thread as u64,
            FULL_THREAD_UM as u64,
        ),
        (
            2,
            "current",
            format!("{} mA", status.current_ma),
            u64::from(status.current_ma),
            u64::from(FULL_CURRENT_MA),
        ),
    ] {
        let full = if y == 1 { "30 mm" } else { "250 mA" };
        sheet.put(0, y, &format!("{name:<8} {value:>10}"), Tone::Strong);
        sheet.bar(20, y, width, part, whole, Tone::Moving);
        sheet.put(21 + width, y, full, Tone::Plain);
    }
    link(panel, at, 3, sheet);
    if let Some(fault) = status.fault {
        let text = format!("FAULT: {fault}");
        sheet.wrap(4, 2, &text, Tone::Bad);
    }
}

/// Draws the quality of the link.
fn link(panel: &Panel, at: Instant, y: u16, sheet: &mut Sheet<'_>) {
    let quality = &panel.quality;
    let silent_s = quality
        .heard
        .map_or(0, |then| at.saturating_duration_since(then).as_secs());
    if silent_s > 0 {
        let text = format!("link: SILENT for {silent_s} s: what is shown is old");
        return sheet.put(0, y, &text, Tone::Bad);
    }
    let answers = quality.round_trip.map_or_else(String::new, |took| {
        format!(", answers in {} ms", took.as_millis())
    });
    let lost = match quality.losses {
        0 => String::new(),
        1 => ", lost once".to_owned(),
        times => format!(", lost {times} times"),
    };
    let text = format!(
        "link: {} samples/s, {} missed, {} bad frames{lost}{answers}",
        quality.samples_per_s(at),
        quality.missed,
        quality.bad_frames,
    );
    sheet.put(0, y, &text, Tone::Plain);
}

/// Draws the latest events of all machines, the newest at the bottom.
fn events(panels: &[Panel], top: u16, bottom: u16, sheet: &mut Sheet<'_>) {
    let mut left = usize::from(bottom.saturating_sub(top));
    let mut lines = vec![];
    // A machine with few events leaves its rows to the next one.
    let mut order: Vec<_> = panels.iter().collect();
    order.sort_by_key(|panel| panel.events.len());
    for (index, panel) in order.iter().enumerate() {
        let share = left / (panels.len() - index);
        let skip = panel.events.len().saturating_sub(share);
        for (time_us, text) in panel.events.iter().skip(skip) {
            let ms = time_us / 1_000;
            let name = identity::kind_name(panel.kind);
            lines.push(format!(
                "{name:<8}{:>7}.{:03} s  {text}",
                ms / 1_000,
                ms % 1_000
            ));
            left -= 1;
        }
    }
    for (y, line) in (top..).zip(&lines) {
        sheet.put(1, y, line, Tone::Plain);
    }
}
