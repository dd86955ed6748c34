//! Forwards unchanged methods of a device that wraps another one.

/// Methods of [`rigless::device::Device`] that call the same method of the device in the named field.
macro_rules! delegate {
    ($inner:ident: $($method:ident),+ $(,)?) => {
        $($crate::emulator::delegate::delegate!(@ $inner $method);)+
    };
    (@ $inner:ident layout) => {
        fn layout(&self) -> &'static [rigless::soc::RegisterSpec] {
            rigless::device::Device::layout(&self.$inner)
        }
    };
    (@ $inner:ident peek) => {
        fn peek(
            &self,
            register: Self::Register,
            registers: &rigless::device::RegisterFile,
            now: rigless::time::VirtualNanos,
        ) -> Option<u64> {
            rigless::device::Device::peek(&self.$inner, register, registers, now)
        }
    };
    (@ $inner:ident read) => {
        fn read(
            &mut self,
            register: Self::Register,
            registers: &mut rigless::device::RegisterFile,
            context: &mut rigless::device::DeviceContext<'_>,
        ) -> Option<u64> {
            rigless::device::Device::read(&mut self.$inner, register, registers, context)
        }
    };
    (@ $inner:ident on_event) => {
        $crate::emulator::delegate::delegate!(@ $inner on_event(event: rigless::time::EventId));
    };
    (@ $inner:ident on_request) => {
        $crate::emulator::delegate::delegate!(@ $inner on_request(request: rigless::device::RequestChange));
    };
    (@ $inner:ident on_refused) => {
        $crate::emulator::delegate::delegate!(@ $inner on_refused(token: u64));
    };
    (@ $inner:ident on_clock) => {
        $crate::emulator::delegate::delegate!(@ $inner on_clock(hz: u64));
    };
    (@ $inner:ident on_access) => {
        $crate::emulator::delegate::delegate!(@ $inner on_access(token: u64, value: u64));
    };
    (@ $inner:ident poll) => {
        $crate::emulator::delegate::delegate!(@ $inner poll());
    };
    (@ $inner:ident reset_line) => {
        $crate::emulator::delegate::delegate!(@ $inner reset_line());
    };
    (@ $inner:ident $method:ident($($name:ident: $type:ty),*)) => {
        fn $method(
            &mut self,
            $($name: $type,)*
            registers: &mut rigless::device::RegisterFile,
            context: &mut rigless::device::DeviceContext<'_>,
        ) {
            rigless::device::Device::$method(&mut self.$inner, $($name,)* registers, context);
        }
    };
}

pub(super) use delegate;
